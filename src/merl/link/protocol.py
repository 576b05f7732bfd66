"""Messages between learner and actor, over TCP: a header in JSON, and bytes.

Nothing that is received is executed or unpickled. Both sides prove that they know the same token
before anything else is read; the data itself is not encrypted.
"""

from __future__ import annotations

import errno
import hmac
import json
import os
import secrets
import socket
import struct
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import merl
from merl.core import MerlError

PORT = 7007
TOKEN = "MERL_TOKEN"
"""Environment variable that holds the token, if no file does."""
CONNECT_SECONDS = 5.0
"""Time limit of a connection's start."""
GREET_SECONDS = 30.0
"""Time limit of each message while both sides introduce themselves."""
DEAD_SECONDS = 10
"""Time after which a peer that no longer answers (a pulled cable) counts as gone."""
_MAGIC = b"MERL"
_HEAD = struct.Struct("<4sIQ")  # magic, bytes of the header, bytes after it
_MOST_HEADER, MOST_BYTES = 2**22, 2**32
_UNKNOWN = 4096
"""Longest message of a peer that has not proved yet that it knows the token."""
_LOCAL = ("127.0.0.1", "localhost", "::1")


class Address(NamedTuple):
    """Host and port."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str, flag: str) -> Address:
        """Parse HOST:PORT, or HOST alone; an IPv6 address with a port needs brackets.

        Raises:
            MerlError: it is neither; the message names the flag.
        """
        host, colon, port = text.rpartition(":")
        if not colon or text.endswith("]") or (text.count(":") > 1 and "]" not in text):
            host, port = text, str(PORT)
        if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
            raise MerlError(f"{flag} takes HOST:PORT, for example 127.0.0.1:{PORT}, not {text!r}")
        return cls(host.strip("[]"), int(port))

    @property
    def is_local(self) -> bool:
        """Whether only this machine can reach it."""
        return self.host in _LOCAL

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def read_token(file: Path | None) -> bytes:
    """Return the token of a file, or else of the environment variable; empty if there is none.

    Raises:
        MerlError: the file cannot be read, or it is empty.
    """
    if file is None:
        return os.environ.get(TOKEN, "").strip().encode()
    try:
        token = Path(file).read_bytes().strip()
    except OSError as error:
        raise MerlError(f"token {file} cannot be read: {error.strerror}") from None
    if not token:
        raise MerlError(f"token {file} is empty: write a long random text into it")
    return token


def listen(address: Address) -> socket.socket:
    """Return a socket that accepts connections.

    Raises:
        MerlError: the port is in use, or the host is not one of this machine.
    """
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    try:
        return socket.create_server(address, family=family)
    except OSError as error:
        way = "name an address of this machine with --actors.listen"
        if error.errno == errno.EADDRINUSE:
            way = "stop the other program, or name another port with --actors.listen"
        number = error.errno or 0  # negative: from the name service
        reason = os.strerror(number) if number > 0 else error.strerror
        raise MerlError(f"cannot listen on {address}: {reason}: {way}") from None


class Channel:
    """A connection that sends and receives messages.

    Args:
        sock: the connected socket.
    """

    def __init__(self, sock: socket.socket) -> None:
        self._socket, self._sending = sock, threading.Lock()
        self.peer: str = sock.getpeername()[0]
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # The kernel notices a pulled cable, however long the peer computes.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in (("TCP_KEEPIDLE", 3), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3)):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * DEAD_SECONDS)

    @classmethod
    def connect(cls, address: Address) -> Channel:
        """Connect to an address.

        Raises:
            OSError: nothing answers there.
        """
        return cls(socket.create_connection(address, timeout=CONNECT_SECONDS))

    def limit(self, seconds: float | None) -> None:
        """Set the time limit of each following call; None waits for as long as the peer lives."""
        self._socket.settimeout(seconds)

    def send(self, header: Mapping[str, Any], payload: bytes = b"") -> None:
        """Send a message.

        Raises:
            OSError: the connection is lost.
        """
        text = json.dumps(header).encode()
        with self._sending:
            self._socket.sendall(_HEAD.pack(_MAGIC, len(text), len(payload)) + text)
            if payload:
                self._socket.sendall(payload)

    def receive(self, most: int = MOST_BYTES) -> tuple[dict[str, Any], bytearray]:
        """Wait for a message and return its header and its bytes, at most `most` of each.

        Raises:
            MerlError: the peer refused; the message is the peer's.
            OSError: the connection is lost, or what arrived is no message.
        """
        magic, size, more = _HEAD.unpack(self._read(_HEAD.size))
        if magic != _MAGIC or size > min(most, _MOST_HEADER) or more > most:
            raise ConnectionError("this is no message of merl")
        try:
            header = json.loads(self._read(size))
        except ValueError:
            raise ConnectionError("a message is damaged") from None
        if not isinstance(header, dict):
            raise ConnectionError("a message is damaged")
        if "error" in header:
            raise MerlError(" ".join(str(header["error"]).split()))
        return header, self._read(more)

    def close(self) -> None:
        """Close the connection; calls that wait on it end."""
        with suppress(OSError):  # the peer has closed it
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _read(self, count: int) -> bytearray:
        data = bytearray(count)
        rest = memoryview(data)
        while rest:
            got = self._socket.recv_into(rest)
            if not got:
                raise ConnectionError("the connection was closed")
            rest = rest[got:]
        return data


def greet_actor(channel: Channel, token: bytes) -> None:
    """Introduce the learner to an actor; both prove that they know the token.

    Raises:
        MerlError: the actor has another token; this also sends it the reason.
        OSError: the connection is lost.
    """
    channel.limit(GREET_SECONDS)
    nonce = secrets.token_hex(16)
    channel.send({"merl": merl.__version__, "nonce": nonce})
    answer, _ = channel.receive(_UNKNOWN)
    nonces = nonce + str(answer.get("nonce"))
    if not _same(_proof(token, "actor", nonces), answer.get("proof")):
        refusal = f"the token is not the learner's: give both the same file, or the same {TOKEN}"
        channel.send({"error": refusal})
        raise MerlError(f"an actor at {channel.peer} has another token")
    channel.send({"proof": _proof(token, "learner", nonces)})


def greet_learner(channel: Channel, token: bytes) -> None:
    """Introduce the actor to the learner; both prove that they know the token.

    Raises:
        MerlError: the learner has another version of merl or another token.
        OSError: the connection is lost, or this is no learner.
    """
    channel.limit(GREET_SECONDS)
    greeting, _ = channel.receive(_UNKNOWN)
    if greeting.get("merl") != merl.__version__:
        raise MerlError(
            f"the learner has merl {greeting.get('merl')}, and this machine {merl.__version__}: "
            "install the same version on both"
        )
    nonce = secrets.token_hex(16)
    nonces = str(greeting.get("nonce")) + nonce
    channel.send({"nonce": nonce, "proof": _proof(token, "actor", nonces)})
    answer, _ = channel.receive(_UNKNOWN)
    if not _same(_proof(token, "learner", nonces), answer.get("proof")):
        raise MerlError(f"what answers at {channel.peer} does not know the token: it is no learner")


def _same(proof: str, given: Any) -> bool:
    """Compare a proof with what the other side has sent, in a time that tells nothing of it."""
    return hmac.compare_digest(proof.encode(), str(given).encode())


def _proof(token: bytes, side: str, nonces: str) -> str:
    return hmac.digest(token or b"-", f"{side} {nonces}".encode(), "sha256").hex()
