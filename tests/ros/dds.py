"""A participant of Cyclone DDS on this machine alone, with readers and writers of ROS topics."""

import threading
import time
from functools import cache
from typing import NamedTuple

from cyclonedds.core import (
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

# found without multicast: on the loopback interface, by port
_CONFIGURATION = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><Peers><Peer address="127.0.0.1"/></Peers>
<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
</Discovery>
<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>"""

_RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))


def qos(*, depth=50, reliable=False, latched=False):
    """The QoS of a ROS topic."""
    policies = [Policy.History.KeepLast(depth)]
    policies.append(_RELIABLE if reliable else Policy.Reliability.BestEffort)
    if latched:
        policies.append(Policy.Durability.TransientLocal)
    return Qos(*policies)


class Received(NamedTuple):
    """A message, and when it came (s of the machine's monotonic clock)."""

    at: float
    message: object


@cache
def _configure(domain):
    """Once in a process."""
    return Domain(domain, _CONFIGURATION)


class Participant:
    """Reads and writes topics by their ROS names, until it is closed."""

    def __init__(self, domain):
        _configure(domain)
        self._participant = DomainParticipant(domain)
        self._entities, self._threads = [], []
        self._closed = threading.Event()

    def close(self):
        """Stop reading."""
        self._closed.set()
        for thread in self._threads:
            thread.join()
        self._entities.clear()

    def write(self, kind, topic, **policies):
        """A function that publishes messages, and the writer."""
        writer = DataWriter(
            self._participant, Topic(self._participant, f"rt/{topic}", kind), qos(**policies)
        )
        self._entities.append(writer)
        return writer

    def read(self, kind, topic, **policies):
        """A list that grows with what is received."""
        reader = DataReader(
            self._participant, Topic(self._participant, f"rt/{topic}", kind), qos(**policies)
        )
        received = []
        # not a listener: Python's are called before there is a reader, and lose what came
        thread = threading.Thread(target=self._collect, args=(reader, received), daemon=True)
        thread.start()
        self._threads.append(thread)
        return received

    def _collect(self, reader, received):
        waitset = WaitSet(self._participant)
        waitset.attach(
            ReadCondition(reader, InstanceState.Any | ViewState.Any | SampleState.NotRead)
        )
        while not self._closed.is_set():
            if waitset.wait(duration(milliseconds=100)):
                now = time.monotonic()
                for sample in reader.take(N=100):
                    if sample.sample_info.valid_data:
                        received.append(Received(now, sample))


def wait_for(condition, timeout=20.0):
    """Wait until a condition holds; returns whether it does."""
    end = time.monotonic() + timeout
    while not (held := condition()) and time.monotonic() < end:
        time.sleep(0.02)
    return held
