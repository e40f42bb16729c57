"""Before and after a flight: predictions for a map, and accuracy of fixes."""
