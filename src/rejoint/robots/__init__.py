"""Arms one can drive: emulated in process, or a myCobot through its vendor's client."""
