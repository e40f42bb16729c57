"""Confidence: numbers that separate right from wrong fixes, and a probability from them."""
