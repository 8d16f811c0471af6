"""Every controller on the same arm with the same targets: protocols, trials and statistics."""
