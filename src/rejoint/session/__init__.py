"""One object that holds an arm, and what drives it."""
