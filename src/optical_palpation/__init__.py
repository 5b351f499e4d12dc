"""Computational optical palpation."""
