"""Image classifiers: those that give gradients, those that only judge, and what makes the latter attackable too."""

from trompe_server.classifiers.diverse import DiverseClassifier
from trompe_server.classifiers.ensemble import as_ensemble, resized
from trompe_server.classifiers.fake import fake_classifier
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import Classifier, ScoringClassifier, WhiteBoxClassifier
from trompe_server.classifiers.registry import load_classifier
from trompe_server.classifiers.score_based import ScoreBasedClassifier, score_based

__all__ = [
    "Classifier",
    "DiverseClassifier",
    "NetworkClassifier",
    "ScoreBasedClassifier",
    "ScoringClassifier",
    "WhiteBoxClassifier",
    "as_ensemble",
    "fake_classifier",
    "load_classifier",
    "resized",
    "score_based",
]
