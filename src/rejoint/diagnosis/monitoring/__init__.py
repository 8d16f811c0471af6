"""What becomes of an arm over months: a short check, charts of its history, and when it will be too worn."""
