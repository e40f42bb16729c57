"""Accuracy of the fixes of a flight against ground truth: metrics, figures and a report.

`metrics` computes and knows neither files nor plots; its parts are `figures` (statistics, APE,
RPE, CEP), `calibration` (confidence and covariance) and `track` (tracked flights, GNSS). `tables`
makes text, rows and JSON values of these records, `plots` draws them, and `report` makes one page.
"""
