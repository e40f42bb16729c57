"""Handing results on: `fixes.jsonl` for people and programs, messages for the autopilot."""
