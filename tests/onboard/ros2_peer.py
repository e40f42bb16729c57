"""The other end of the graph: a participant that encodes and decodes by hand-written types.

Loopback only: every test has a domain of its own, and no multicast leaves the machine.
"""

import os
import random

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

LOOPBACK = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/>'
    "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>"
    '<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>'
    "</Discovery></Domain></CycloneDDS>"
)
BEST_EFFORT, RELIABLE = Policy.Reliability.BestEffort, Policy.Reliability.Reliable(10**8)
TRANSIENT_LOCAL = Policy.Durability.TransientLocal


def environment():
    """The environment of a process that joins a random domain on the loopback."""
    # Tests side by side never share one; up to 100, whose ports are below those of other programs.
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    domain = 4 * random.Random(os.urandom(8)).randint(0, 24) + 1 + worker % 4
    return {"CYCLONEDDS_URI": LOOPBACK, "ROS_DOMAIN_ID": str(domain)}


class Peer:
    """Writes and reads topics of ROS 2 in the domain of `os.environ`."""

    def __init__(self, domain):
        self.participant = DomainParticipant(int(domain))
        self._writers, self._readers, self._heard = {}, {}, {}

    def advertise(self, topic, kind, *policies):
        made = Topic(self.participant, f"rt{topic}", kind)
        qos = Qos(*(policies or (RELIABLE,)), Policy.History.KeepLast(10))
        self._writers[topic] = DataWriter(self.participant, made, qos)

    def subscribe(self, topic, kind, *policies):
        made = Topic(self.participant, f"rt{topic}", kind)
        qos = Qos(*(policies or (RELIABLE,)), Policy.History.KeepLast(1000))
        self._readers[topic] = DataReader(self.participant, made, qos)
        self._heard[topic] = []

    def write(self, topic, message):
        self._writers[topic].write(message)

    def matched(self):
        """Whether every writer has a reader."""
        return all(
            writer.get_publication_matched_status().current_count > 0
            for writer in self._writers.values()
        )

    def heard(self, topic):
        """All messages of a topic so far."""
        taken = self._readers[topic].take(1000)
        self._heard[topic] += [each for each in taken if hasattr(each, "serialize")]
        return self._heard[topic]

    def close(self):
        self._writers.clear()
        self._readers.clear()
        self.participant = None
