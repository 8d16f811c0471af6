"""The compiled step of free twins; MuJoCo, which judges it, steps those that may touch a table."""
