"""On board: running the localizer over views as they come, live or from a recorded flight."""
