"""Labelling failures: a local page, suggestions from a trained filter, automatic labels, labels as data."""
