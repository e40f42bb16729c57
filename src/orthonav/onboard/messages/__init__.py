"""Outputs of results: `fixes.jsonl` for people and programs, messages for autopilots."""
