"""True tool positions: measured from outside, modelled as displacements."""
