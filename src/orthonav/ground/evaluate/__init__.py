"""Accuracy of the fixes of a flight against ground truth: metrics, figures and a report.

`statistics`, `metrics` and `track` compute and know neither files nor plots. `tables` makes text,
rows and JSON values of their records, and `report` makes one page with figures.
"""
