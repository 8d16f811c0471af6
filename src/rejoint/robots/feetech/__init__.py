"""SO-100 and SO-101 arms on the bus of their Feetech servos."""
