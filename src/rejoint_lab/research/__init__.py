"""Experiments of the paper and rival controllers; not imported by the product."""
