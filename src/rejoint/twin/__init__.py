"""The fitted model of an arm: parameters, MuJoCo model, batch and identification."""
