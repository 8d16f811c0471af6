"""The controllers: open loop, integrator, feedforward, postures, policies; their law, and the contract of a policy."""
