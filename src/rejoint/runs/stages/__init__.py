"""The stages of a repair, one module each: from files to files in a run folder, or on data in memory."""
