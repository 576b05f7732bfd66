"""An actor's connection to its learner, which it makes again whenever it is lost."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from typing import Any

from merl.core import MerlError
from merl.link.protocol import Address, Channel, greet_learner
from merl.link.spool import Spool
from merl.link.timesteps import Layout

RETRY_SECONDS = 1.0
"""Time between two attempts to connect."""
_MOST_SENT = 64
"""Largest number of timesteps in a message."""
_LOG = logging.getLogger(__name__)


def reach(address: Address, token: bytes) -> tuple[Channel, dict[str, Any]]:
    """Connect to a learner; return the channel and the config of the run, as plain types.

    Raises:
        MerlError: no learner is there, or it refuses.
    """
    channel = None
    try:
        channel = Channel.connect(address)
        greet_learner(channel, token)
        message, _ = channel.receive()
        return channel, message["config"]
    except (OSError, KeyError) as error:
        if channel is not None:
            channel.close()
        reason = error.strerror if isinstance(error, OSError) else None
        raise Unreachable(
            f"no learner answers at {address} ({reason or error}): start it with `merl learner "
            f"TASK --actors.listen {address}`, or name another --connect"
        ) from None
    except MerlError:
        if channel is not None:
            channel.close()
        raise


class Unreachable(MerlError):  # noqa: N818 (a state)
    """No learner answers."""


class Connection:
    """Sends the timesteps of a spool to a learner, and receives weights.

    A thread connects, again and again; another sends.

    Args:
        address: where the learner listens.
        token: the shared secret.
        spool: the timesteps.
        layout: their form.
        spaces: the spaces of the environment, as `merl.runs.record.describe_spaces` describes them.

    Attributes:
        place: number of the actor's ring in the learner's replay; None before `open`.
        stored: number of the newest timestep in the learner's replay.
        saved: number of the newest timestep in a checkpoint of the learner.
        step: environment steps of the run, of all actors.
        updates: the learner's updates.
        done: whether the run has ended.
    """

    def __init__(
        self,
        address: Address,
        token: bytes,
        spool: Spool,
        layout: Layout,
        spaces: Mapping[str, Any],
    ) -> None:
        self._address, self._token, self._spool = address, token, spool
        self._layout, self._spaces = layout, spaces
        self._changed = threading.Condition()
        self._channel: Channel | None = None
        self._weights: tuple[dict[str, Any], bytearray] | None = None
        self._error: Exception | None = None
        self._closed = False
        self.place: int | None = None
        self.stored = self.saved = self.step = self.updates = 0
        self.done = False

    def open(self, channel: Channel) -> None:
        """Introduce the actor on its first channel, and keep it connected from now on.

        Raises:
            MerlError: the learner refuses, or the spool does not fit.
        """
        try:
            received = self._introduce(channel)
        except OSError:
            raise Unreachable(
                f"the learner at {self._address} ended the connection: see its output"
            ) from None
        threading.Thread(target=self._keep, args=(channel, received), daemon=True).start()

    def check(self) -> None:
        """Raise the error that ended the connection for good, if there is one."""
        if self._error is not None:
            raise self._error

    def notify(self) -> None:
        """Tell the sending thread that there is a new timestep."""
        with self._changed:
            self._changed.notify_all()

    def take_weights(self) -> tuple[dict[str, Any], bytearray] | None:
        """Return the newest weights that have not been taken; None if there are none."""
        with self._changed:
            weights, self._weights = self._weights, None
        return weights

    def wait(self, behind: int, seconds: float) -> bool:
        """Wait until at most `behind` timesteps are not in the replay yet, or the run is done.

        Returns:
            Whether that is so; False after `seconds`.
        """

        def ready() -> bool:
            is_near = self._spool.last - self.stored <= behind
            return is_near or self.done or self._error is not None

        with self._changed:
            return self._changed.wait_for(ready, seconds)

    def close(self, seconds: float = 5.0) -> None:
        """Wait for the last timesteps to arrive, for at most `seconds`, and disconnect."""
        if self._channel is not None and self._error is None:
            self.wait(0, seconds)
        self._closed = True
        channel = self._channel
        if channel is not None:
            channel.close()

    def _keep(self, channel: Channel, received: int) -> None:
        """Stay connected until the run is done, an error occurs, or `close`."""
        lost = False
        while not self._closed:
            try:
                if lost:
                    channel, _ = reach(self._address, self._token)
                    received = self._introduce(channel)
                    _LOG.warning("connected to %s again", self._address)
                    lost = False
                self._talk(channel, received)
            except (OSError, Unreachable) as error:
                if not (lost or self._closed):
                    _LOG.warning("lost the learner at %s (%s): trying again", self._address, error)
                lost = True
            except Exception as error:  # raised in the acting thread
                self._error = error
                self._closed = True
            finally:
                with self._changed:
                    self._channel = None
                    self._changed.notify_all()
                channel.close()
            if self.done:
                return
            time.sleep(RETRY_SECONDS if lost else 0.0)

    def _introduce(self, channel: Channel) -> int:
        """Agree with the learner on run, place and timesteps; return the number that it has."""
        channel.limit(None)  # the learner may still time its machine
        channel.send({"spaces": self._spaces})
        message, _ = channel.receive()
        run, is_first = str(message["run"]), self.place is None
        if not is_first and self._spool.run != run:
            raise MerlError("the learner trains another run now: restart the actor")
        self._spool.belong_to(run)
        channel.send({"actor": self._spool.id})
        message, _ = channel.receive()
        received = int(message["received"])
        if is_first:
            self._spool.start(received, self._layout.size, self._layout.number)
        elif not self._spool.first - 1 <= received <= self._spool.last:
            raise MerlError("the learner resumed from another checkpoint: restart the actor")
        with self._changed:
            self.place = int(message["place"])
            self.stored = min(int(message["stored"]), received)
        return received

    def _talk(self, channel: Channel, received: int) -> None:
        """Send timesteps in a second thread, and receive; return when the run is done."""
        with self._changed:
            self._channel = channel
        sender = threading.Thread(target=self._send, args=(channel, received + 1), daemon=True)
        sender.start()
        try:
            while not self.done:
                message, data = channel.receive()
                with self._changed:
                    for name in ("stored", "saved", "step", "updates"):
                        setattr(self, name, int(message.get(name, getattr(self, name))))
                    if "weights" in message:
                        self._weights = message, data
                    self.done = bool(message.get("done"))
                    self._changed.notify_all()
                if "saved" in message:
                    self._spool.discard(self.saved)
        finally:
            channel.close()
            with self._changed:
                self._channel = None
                self._changed.notify_all()
            sender.join()

    def _send(self, channel: Channel, number: int) -> None:
        """Send the timesteps from `number` on, each once it is on the disk."""
        spool, window = self._spool, self._layout.window

        def ready() -> bool:
            return self._channel is not channel or number <= min(spool.last, self.stored + window)

        while True:
            with self._changed:
                self._changed.wait_for(ready)
                if self._channel is not channel:
                    return
                last = min(spool.last, self.stored + window)
            try:
                spool.sync()
                data = spool.read(number, min(_MOST_SENT, last - number + 1))
                channel.send({}, data)
            except (OSError, MerlError) as error:
                if isinstance(error, MerlError):  # of the spool; raised in the acting thread
                    self._error, self._closed = error, True
                channel.close()  # ends `_talk`, which else connects again
                return
            number += len(data) // self._layout.size
