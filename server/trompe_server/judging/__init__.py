"""Results of an attack: accuracies with confidence intervals, and the visibility of the change."""
