"""One judgement of two model files, before and after, whoever painted the second: no surrogate, no attack."""
