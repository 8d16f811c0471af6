"""Where the tool really is: measured from outside, modelled as displacements, judged on what the fit has not seen."""
