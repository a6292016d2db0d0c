"""How much memory a piece of work takes."""

import threading

import psutil


class PeakMemory:
    """The most memory of this process while the block runs, beyond what it held before, in MiB."""

    def __enter__(self):
        self._process = psutil.Process()
        self._before = self._process.memory_info().rss
        self._peak = self._before
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def _watch(self):
        while not self._done.wait(0.005):
            self._peak = max(self._peak, self._process.memory_info().rss)

    def __exit__(self, *_):
        self._done.set()
        self._thread.join()
        self.mib = (max(self._peak, self._process.memory_info().rss) - self._before) / 2**20
