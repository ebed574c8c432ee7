"""A client of RTDE that knows nothing but packages."""

import socket
import struct

from robot_process import PATIENCE

from rhp_drake.lab.rtde_server import RTDE_PORT


def package(kind, payload=b""):
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


class RawClient:
    """Speaks RTDE, package by package."""

    def __init__(self, host):
        self.socket = socket.create_connection((host, RTDE_PORT), PATIENCE)
        self.file = self.socket.makefile("rb")

    def receive(self):
        size, kind = struct.unpack(">HB", self.file.read(3))
        return chr(kind), self.file.read(size - 3)

    def ask(self, kind, payload=b""):
        self.socket.sendall(package(kind, payload))
        answered, answer = self.receive()
        assert answered == kind
        return answer

    def start(self, names, frequency=125.0):
        """Asks for variables; their types."""
        answer = self.ask("O", struct.pack(">d", frequency) + ",".join(names).encode())
        assert answer[0] == 1
        assert self.ask("S") == b"\x01"
        return answer[1:].decode()

    def close(self):
        self.file.close()
        self.socket.close()
