"""Where the tool really is: measured from outside, modelled as displacements, judged on points left out."""
