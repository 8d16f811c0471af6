"""Base of all packages: errors, files, interruption, extras."""
