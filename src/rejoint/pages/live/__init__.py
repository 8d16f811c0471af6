"""The live view: a page that shows an arm while it is driven, and can ask for it to be held.

The control loop only puts a record into a ring (`ring`). A thread (`view`) reads it 25 times a second (`animation`),
has the twin predict the same commands (`ghost`), keeps what is left of the last seconds (`trails`), says in words what
the guard did (`words`, `panel`), and draws the arm's capsules (`skeleton`). `page` alone knows viser, which makes a web
page of it.
"""
