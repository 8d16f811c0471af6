"""What the product never imports: the experiments of the paper, arms never met, classical and off-policy rivals."""
