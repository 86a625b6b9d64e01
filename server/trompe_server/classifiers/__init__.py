"""Image classifiers: white boxes with gradients, networks with scores only, and wrappers around both."""

from trompe_server.classifiers.ensemble import as_ensemble, resized
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import Classifier, ScoringClassifier, WhiteBoxClassifier
from trompe_server.classifiers.registry import classifier_file, load_classifier
from trompe_server.classifiers.score_based import ScoreBasedClassifier, score_based
from trompe_server.classifiers.toolboxes import from_art, from_foolbox

__all__ = [
    "Classifier",
    "NetworkClassifier",
    "ScoreBasedClassifier",
    "ScoringClassifier",
    "WhiteBoxClassifier",
    "as_ensemble",
    "classifier_file",
    "from_art",
    "from_foolbox",
    "load_classifier",
    "resized",
    "score_based",
]
