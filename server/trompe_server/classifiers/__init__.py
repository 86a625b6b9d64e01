"""Image classifiers: those that can be attacked (``.pt2``, ``tiny``) and those that only judge (``.onnx``)."""

from trompe_server.classifiers.fake import fake_classifier
from trompe_server.classifiers.network import NetworkClassifier
from trompe_server.classifiers.protocol import Classifier, WhiteBoxClassifier
from trompe_server.classifiers.registry import load_classifier

__all__ = ["Classifier", "NetworkClassifier", "WhiteBoxClassifier", "fake_classifier", "load_classifier"]
