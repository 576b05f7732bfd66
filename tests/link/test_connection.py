"""What an actor removes from its spool, and when."""

from __future__ import annotations

import socket
import threading
from pathlib import Path

import pytest
from test_spool import LAYOUT, fill

from helpers import wait_for
from merl.core import MerlError
from merl.link.connection import Connection
from merl.link.protocol import Address, Channel
from merl.link.spool import Spool


def test_timesteps_stay_until_a_checkpoint_holds_them(tmp_path: Path) -> None:
    """The learner has stored all nine, and its checkpoint holds five of them."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        Spool.open(tmp_path) as spool,
    ):
        spool.belong_to("run")
        spool.start(0, LAYOUT.size, LAYOUT.number)
        address = Address("127.0.0.1", server.getsockname()[1])
        connection = Connection(address, b"", spool, LAYOUT, {})
        channel = Channel.connect(address)
        learner = Channel(server.accept()[0])
        thread = threading.Thread(target=connection._talk, args=(channel, 9), daemon=True)
        thread.start()
        for count in (5, 4):
            fill(spool, count)
            spool.discard(0)  # begins a file
        learner.send({"stored": 9, "updates": 1})
        wait_for(lambda: connection.updates == 1)
        assert (spool.first, spool.last) == (1, 9)
        learner.send({"stored": 9, "saved": 5, "done": True})
        thread.join(60)
        assert (spool.first, spool.last) == (6, 9)
        learner.close()


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("10.0.0.7:9", "10.0.0.7", 9),
        ("arm", "arm", 7007),
        ("::1", "::1", 7007),
        ("[::1]", "::1", 7007),
        ("[::1]:9", "::1", 9),
    ],
)
def test_addresses(text: str, host: str, port: int) -> None:
    assert Address.parse(text, "--connect") == (host, port)


def test_an_address_without_a_port_in_range_is_refused() -> None:
    with pytest.raises(MerlError, match="--connect takes HOST:PORT"):
        Address.parse("arm:70000", "--connect")
