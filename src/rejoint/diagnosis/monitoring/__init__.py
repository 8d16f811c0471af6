"""An arm over months: a short check, charts of its history, and its remaining time."""
