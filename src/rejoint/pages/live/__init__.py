"""The live view: the control loop writes a ring; a thread (`view`) draws it on the `page`."""
