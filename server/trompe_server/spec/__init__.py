"""Rules of a job: options that fit together, class labels."""
