"""One job from object to result: setup, phases, the attack on the texture, its files, its report."""
