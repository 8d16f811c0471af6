"""An arm over months: checks, charts, and remaining service time."""
