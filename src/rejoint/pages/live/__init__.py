"""The live view: a page that shows an arm while it is driven, and can ask for it to be held.

The control loop only puts records into a ring (`records`); a thread (`view`) draws them (`animation`) on the page
(`page`), the one module that knows viser.
"""
