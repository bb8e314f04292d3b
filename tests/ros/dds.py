"""A participant of Cyclone DDS on this machine alone, with readers and writers of ROS topics."""

import time
from functools import cache
from typing import NamedTuple

from cyclonedds.core import Listener, Policy, Qos
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


class _Collector(Listener):
    def __init__(self):
        super().__init__()
        self.received = []

    def on_data_available(self, reader):
        now = time.monotonic()
        for sample in reader.take(N=100):
            if sample.sample_info.valid_data:
                self.received.append(Received(now, sample))


@cache
def _configure(domain):
    """Once in a process."""
    return Domain(domain, _CONFIGURATION)


class Participant:
    """Reads and writes topics by their ROS names."""

    def __init__(self, domain):
        _configure(domain)
        self._participant = DomainParticipant(domain)
        self._entities = []

    def write(self, kind, topic, **policies):
        """A function that publishes messages, and the writer."""
        writer = DataWriter(
            self._participant, Topic(self._participant, f"rt/{topic}", kind), qos(**policies)
        )
        self._entities.append(writer)
        return writer

    def read(self, kind, topic, **policies):
        """A list that grows with what is received."""
        collector = _Collector()
        reader = DataReader(
            self._participant,
            Topic(self._participant, f"rt/{topic}", kind),
            qos(**policies),
            listener=collector,
        )
        self._entities.append(reader)
        return collector.received


def wait_for(condition, timeout=20.0):
    """Wait until a condition holds; returns whether it does."""
    end = time.monotonic() + timeout
    while not (held := condition()) and time.monotonic() < end:
        time.sleep(0.02)
    return held
