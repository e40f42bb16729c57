"""Confidence: numbers that separate right from wrong, and the probability made of them."""
