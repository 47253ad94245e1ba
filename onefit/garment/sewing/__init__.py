"""Sewing: measures of a pattern go in, a garment's mesh around the standard body comes out: the
templates of the package, and random cuts to train on.
"""
