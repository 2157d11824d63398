"""Workers for tests: two at a time as far as the caller can tell, in this process."""

import pickle
from typing import Any

from aerpaw_cmp.jobs.workers import InProcess


class SentByPickle(InProcess):
    """A pool that pickles tasks and results, as on the way to a process and back.

    ``sizes`` are the sizes of the tasks [bytes].
    """

    count = 2

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def run(self, function: Any, items: Any, done: Any) -> None:
        for number, item in enumerate(items):
            sent = pickle.dumps(item)
            self.sizes.append(len(sent))
            done(number, pickle.loads(pickle.dumps(function(pickle.loads(sent)))))
