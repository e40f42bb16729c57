"""Accuracy of the fixes of a flight against ground truth: metrics, figures and a report.

`metrics` computes and knows neither files nor plots; its parts are `standard` (APE, RPE, CEP),
`calibration` (confidence and covariance) and `track` (tracked flights). Modules named `plots` draw,
`flights` makes tables and JSON values, `report` makes one page.
"""
