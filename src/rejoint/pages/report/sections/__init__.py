"""The sections of the page, one module each: from the files of a run to what the template shows."""
