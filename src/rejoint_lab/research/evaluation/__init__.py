"""Controllers on many arms that nothing was chosen on: trials, paired statistics, failures, the page."""
