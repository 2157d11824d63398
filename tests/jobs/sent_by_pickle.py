"""Workers for tests: two at a time as far as the caller can tell, in this process."""

import pickle
from typing import Any

from aerpaw_cmp.jobs.workers import InProcess


class SentByPickle(InProcess):
    """Orders and results go through pickle, as to a process and back; ``sizes`` are those of the orders [bytes]."""

    count = 2

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def run(self, function: Any, items: Any, done: Any) -> None:
        for number, item in enumerate(items):
            sent = pickle.dumps(item)
            self.sizes.append(len(sent))
            done(number, pickle.loads(pickle.dumps(function(pickle.loads(sent)))))
