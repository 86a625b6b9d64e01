"""Experiments: a grid of jobs from a file, run with one command, resumable, kept as CSV.

Reading order: ``design`` (the file), ``plan`` (its jobs), ``service`` (the server), ``run`` (the runner), ``table``
(its results), ``figures``.
"""
