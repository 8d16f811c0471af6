"""The emulated bus of an SO-101: six STS3215 servos behind one serial line, as their firmware behaves."""
