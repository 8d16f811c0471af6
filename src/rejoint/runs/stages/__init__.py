"""The stages of a repair, one module each."""
