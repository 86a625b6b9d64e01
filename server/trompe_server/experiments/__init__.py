"""What is made of an experiment's tables: figures, the report; and what runs on the library itself: the perturbed
renderers of the stability suite, adversarial variants of objects.

The figures need the ``report`` extra (matplotlib). Each is a function of rows of ``results.csv`` alone.
"""
