"""The myCobot's wire protocol as its robot's side speaks it: pure functions, without a clock, a socket or a servo.

Frames (`frames`), numbers (`values`), ways of an arm (`paths`), where a reference is on them (`motion`), and what each
request asks of the `Computer` behind the wire (`states`, `orders`, `commands`). The emulated arm is such a computer,
and so is what `rejoint serve` puts before a real one. The driver never uses any of it: it speaks through the vendor's
client.
"""
