"""The actors of a run, as its learner sees them: they connect, and send what they did.

A thread accepts connections; for each actor one thread reads and one writes. They touch neither the
agent nor the replay: the loop stores what they received.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from torch import Tensor

from merl.acting.instances import EnvSpaces, own_bounds
from merl.acting.rollout import Episode
from merl.acting.still import StillEnv
from merl.callbacks import Callback
from merl.config import TrainConfig
from merl.core import MerlError
from merl.core.guards import check_finite
from merl.envs.user_env import MakeEnv
from merl.link import weights
from merl.link.places import Place, place_of
from merl.link.protocol import TOKEN, Address, Channel, greet_actor, listen, read_token
from merl.link.timesteps import Layout, Timestep
from merl.runs import record
from merl.runs.plain import to_plain
from merl.runs.run import Run
from merl.training.loop import Progress
from merl.training.outcome import Outcome

if TYPE_CHECKING:
    from merl.training.trainer import Trainer

WAIT = 0.2
"""Seconds after which the loop looks for signals, if no timestep arrives."""
PAUSE = 0.005
"""Seconds between two messages to an actor, which each tell all news."""
END = 10.0
"""Seconds within which the actors must have heard that the run is done."""
_LOG = logging.getLogger(__name__)


class Actors(Callback):
    """The actors of a run; `store` gives the loop what they send.

    Args:
        config: the config of the run.
        server: accepts their connections.
        token: the shared secret.
    """

    def __init__(self, config: TrainConfig, server: socket.socket, token: bytes) -> None:
        self._config, self._server, self._token = config, server, token
        self._changed = threading.Condition()  # of all attributes below
        self._news = 0  # counts what the actors are to be told
        self._spaces: Mapping[str, Any] | None = None
        self._layout: Layout | None = None
        self._weights: tuple[dict[str, Any], bytes] | None = None
        self._is_closed = self._is_done = False
        self._queue: SimpleQueue[tuple[int, Timestep]] = SimpleQueue()
        self._places = [Place() for _ in range(config.num_envs)]
        self._published = 0  # updates of the newest weights

    @classmethod
    @contextmanager
    def listening(cls, config: TrainConfig) -> Iterator[Actors | None]:
        """Listen at the address of the config; yield None if it has none.

        Raises:
            MerlError: the address or the token cannot be used, or actors cannot have the agent.
        """
        if not config.has_actors:
            yield None
            return
        weights.check_can_act(config)
        address = Address.parse(str(config.actors.listen), "--actors.listen")
        token = read_token(config.actors.token)
        if not (token or address.is_local):
            raise MerlError(
                f"actors.listen {address} can be reached from other machines: set a secret with "
                f"--actors.token FILE, or in {TOKEN}, here and for each actor"
            )
        actors = cls(config, listen(address), token)
        threading.Thread(target=actors._accept, daemon=True).start()
        try:
            yield actors
        finally:
            actors.close()

    def make_env(self, resumed: Run | None) -> MakeEnv | None:
        """Return what makes an environment with the spaces of the actors'; None if merl makes it.

        Args:
            resumed: the run that resumes; for a new run, wait for the first actor.
        """
        if not self._config.lacks_env:
            return None
        if resumed is not None:
            described: Mapping[str, Any] = record.read(resumed.path)
        else:
            _LOG.warning("waiting at %s for the first actor", self._config.actors.listen)
            with self._changed:
                while self._spaces is None:
                    self._changed.wait(WAIT)
                described = self._spaces
        bounds = described["action_space"]["own_bounds"]
        known = EnvSpaces(*record.spaces_of(described), bounds)
        return lambda: StillEnv(known)

    # Events of training ---------------------------------------------------------------------

    def on_start(self, trainer: Trainer) -> None:
        """Serve the actors from now on."""
        self._replay, self._trainer, setup = trainer.replay, trainer, trainer.setup
        bounds = own_bounds(setup.env)
        for place, ring in zip(self._places, self._replay.rings, strict=True):
            place.received = place.saved = ring.timesteps
        self._publish()
        with self._changed:
            self._spaces = record.describe_spaces(setup.space, setup.action_space, bounds)
            self._layout = Layout(setup.space, setup.action_space)
            self._changed.notify_all()

    def on_update(self, step: int, metrics: Mapping[str, Tensor]) -> None:
        """Send the policy, every `weights_every` updates."""
        if self._trainer.progress.updates - self._published >= self._config.actors.weights_every:
            self._publish()

    def on_checkpoint(self, step: int) -> None:
        """Tell the actors which timesteps they need no longer keep."""
        with self._changed:
            for place, ring in zip(self._places, self._replay.rings, strict=True):
                place.saved = ring.timesteps
            self._tell()

    def on_end(self, outcome: Outcome | None) -> None:
        """Tell the actors that the run is done, if it is."""
        if outcome is None or outcome.progress.step < self._config.steps:
            return
        with self._changed:
            self._is_done = True
            self._tell()
        end = time.monotonic() + END
        for place in self._places:  # each session ends when its actor has heard it
            if place.session.acquire(timeout=max(0.0, end - time.monotonic())):
                place.session.release()

    def close(self) -> None:
        """Close all connections."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)  # ends `accept`
        self._server.close()
        for place in self._places:
            if place.channel is not None:
                place.channel.close()

    def store(self, progress: Progress, repeat: int) -> tuple[Episode, ...]:
        """See `merl.training.loop.Receiver`."""
        while True:
            try:
                index, timestep = self._queue.get(timeout=WAIT)
            except Empty:
                return ()
            ring, step = self._replay.rings[index], timestep.transition
            # A ring that lost its newest timesteps (a full disk) begins anew within an episode.
            begins = step is None or not ring.in_progress
            if step is None or begins:
                self._replay.begin(timestep.observation, index)
            else:
                self._replay.add(step, index)
                progress.step += repeat
            with self._changed:
                self._tell()
            if step is not None and not begins:
                return (timestep.episode,) if step.last else ()

    def _publish(self) -> None:
        self._published = self._trainer.progress.updates
        form, data = weights.pack(self._trainer.setup.agent)
        with self._changed:
            self._weights = {"weights": form}, data
            self._tell()

    def _tell(self) -> None:
        self._news += 1
        self._changed.notify_all()

    # Threads --------------------------------------------------------------------------------

    def _accept(self) -> None:
        while True:
            try:
                accepted, _ = self._server.accept()
            except OSError:
                if self._is_closed:
                    return
                time.sleep(WAIT)  # too many open files
                continue
            threading.Thread(target=self._serve, args=(accepted,), daemon=True).start()

    def _serve(self, accepted: socket.socket) -> None:
        """Serve a connection to its end; tell the peer why it is refused."""
        channel = None
        try:
            channel = Channel(accepted)
            greet_actor(channel, self._token)
            index = self._introduce(channel)
            if index is not None:
                self._exchange(index, channel)
        except (OSError, KeyError, TypeError, ValueError):
            pass  # the peer is gone, or is no actor
        except MerlError as error:
            _LOG.warning("%s", error)
            with suppress(OSError):
                channel.send({"error": str(error)}) if channel is not None else None
        finally:
            accepted.close() if channel is None else channel.close()

    def _introduce(self, channel: Channel) -> int | None:
        """Agree with an actor on spaces and place; return its place, None if training has ended.

        Raises:
            MerlError: its environment does not fit, or there is no place for it.
        """
        channel.send({"config": to_plain(self._config)})
        message, _ = channel.receive(2**20)
        given = message["spaces"]
        record.spaces_of(given)
        with self._changed:
            if self._spaces is None:
                self._spaces = given
                self._changed.notify_all()
            channel.limit(None)
            self._changed.wait_for(lambda: self._layout is not None or self._is_closed)
            if self._is_closed or self._spaces is None:
                return None
            differs = record.changed_spaces(self._spaces, given)
        if differs:
            raise MerlError(
                f"the environment of the actor at {channel.peer} differs from that of the run: "
                f"{'; '.join(differs)}"
            )
        channel.send({"run": self._trainer.run.public_id})
        message, _ = channel.receive(4096)
        with self._changed:
            return place_of(str(message["actor"]), self._trainer.run.path, len(self._places))

    def _exchange(self, index: int, channel: Channel) -> None:
        """Receive timesteps, and send news in a second thread, until the connection ends."""
        place = self._places[index]
        with self._changed:
            former, place.channel = place.channel, channel
            self._changed.notify_all()
        if former is not None:
            former.close()  # it may look alive long after the actor has lost it
        with place.session:
            stored = self._replay.rings[index].timesteps
            channel.send({"place": index, "received": place.received, "stored": stored})
            if former is not None:
                _LOG.warning("actor %s (%s) is connected again", index, channel.peer)
            writer = threading.Thread(target=self._write, args=(index, channel), daemon=True)
            writer.start()
            try:
                self._read(index, channel)
            except OSError:
                if not (self._is_closed or self._is_done) and place.channel is channel:
                    _LOG.warning("lost actor %s (%s): waiting for it", index, channel.peer)
            finally:
                channel.close()
                with self._changed:
                    self._changed.notify_all()
                writer.join()

    def _read(self, index: int, channel: Channel) -> None:
        """Queue the timesteps of an actor.

        Raises:
            MerlError: a timestep is missing, damaged or not finite.
        """
        place, layout = self._places[index], self._layout
        assert layout is not None
        while True:
            _, data = channel.receive(layout.window * layout.size)
            for at in range(0, len(data), layout.size):
                part = memoryview(data)[at : at + layout.size]
                if layout.number(part) != place.received + 1:
                    raise MerlError(
                        f"actor {index} sent another timestep than number {place.received + 1:,}"
                    )
                timestep = layout.unpack(part)
                reward = 0.0 if timestep.transition is None else timestep.transition.reward
                check_finite(timestep.observation, reward, timestep.number, f"of actor {index}")
                self._queue.put((index, timestep))
                place.received += 1

    def _write(self, index: int, channel: Channel) -> None:
        """Send an actor all news, and the newest weights."""
        place, told, saved, sent = self._places[index], -1, -1, None
        progress, ring = self._trainer.progress, self._replay.rings[index]

        def ready() -> bool:
            return self._news != told or self._is_closed or place.channel is not channel

        with suppress(OSError):  # `_read` sees it too
            while not self._is_closed and place.channel is channel:
                with self._changed:
                    self._changed.wait_for(ready, 1.0)
                    told, is_done, newest = self._news, self._is_done, self._weights
                    news = {"stored": ring.timesteps, "done": is_done}
                    news |= {"step": progress.step, "updates": progress.updates}
                    if place.saved != saved:
                        news["saved"] = saved = place.saved
                if newest is not None and newest is not sent:
                    sent = newest
                    channel.send(newest[0] | news, newest[1])
                else:
                    channel.send(news)
                if is_done:
                    return
                time.sleep(PAUSE)
