"""The live view: a page that shows a driven arm, with a button to hold it.

The control loop writes a ring (`records`); a thread (`view`) draws it (`animation`) on the page (`page`).
"""
