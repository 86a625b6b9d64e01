"""The renderer worker: SAILenv's socket protocol outside, physically based rendering with pyrender inside."""
