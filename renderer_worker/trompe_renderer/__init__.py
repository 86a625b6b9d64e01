"""The renderer worker: a server of SAILenv's socket protocol that renders with pyrender."""
