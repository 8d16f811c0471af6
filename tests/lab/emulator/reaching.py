"""Where a server is."""


def place(server):
    host, port = server.address.removeprefix("tcp://").rsplit(":", 1)
    return host, int(port)
