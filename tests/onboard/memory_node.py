"""A node without ROS: what others write and hear of its topics stays in this process."""

from collections import defaultdict, deque

from benchmarks.fakes import Time

from orthonav.onboard.ros2.node import Node


class MemoryNode(Node):
    """`time` goes on while it waits in vain. `heard`: messages by topic. `latched`, `reliable`:
    topics with such a writer or reader of ours. `types`: those of others, by topic."""

    def __init__(self, words=(), distro=""):
        pairs = zip(words[::2], words[1::2], strict=True)
        self._given_words = {"-r": {}, "-p": {}}
        for flag, text in pairs:
            name, _, value = text.partition(":=")
            self._given_words[flag][name] = value
        self.time, self.heard = Time(), defaultdict(list)
        self.latched, self.reliable, self.types = set(), set(), defaultdict(set)
        self._handlers, self._waiting = {}, deque()
        super().__init__(words, distro)

    def _join(self, words):
        """Nobody to join."""
        return "orthonav", "/orthonav"

    def _declared(self, name, default):
        given = self._given_words["-p"].get(name, default)
        return given == "true" if name == "use_sim_time" else given

    def _given(self):
        return [*self._given_words["-p"]]

    def _types_of_others(self, topic):
        return self.types[topic]

    def resolved(self, topic):
        expanded = topic.replace("~", "/orthonav")
        return self._given_words["-r"].get(topic, f"/{expanded.removeprefix('/')}")

    def is_remapped(self, topic):
        return topic in self._given_words["-r"]

    def subscribe(self, topic, kind, handler, *, depth=5, reliable=False):
        self._handlers[topic], self.kinds[topic] = (kind, handler), kind
        if reliable:
            self.reliable.add(topic)

    def advertise(self, topic, kind, *, depth=10, latched=False):
        self.kinds[topic] = kind
        if latched:
            self.latched.add(topic)
        hear = self.heard[topic].append
        return self._writing(topic, lambda cdr: hear(self.definitions.decoded(kind, cdr)))

    def write(self, topic, cdr):
        """A sample of another node, read by the next `spin`."""
        self._waiting.append((topic, cdr))

    def spin(self, timeout_s):
        self._handled = 0
        while self._waiting:
            topic, cdr = self._waiting.popleft()
            self._handle(topic, *self._handlers[topic], cdr)
        if not self._handled:
            self.time.go(timeout_s)
        return self._handled

    def close(self):
        """Nothing to leave."""
