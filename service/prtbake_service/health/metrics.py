"""Numbers for Prometheus."""

from collections.abc import Callable, Iterator, Mapping

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

# seconds: an answer from memory to a long poll of a minute
_BUCKETS = (0.005, 0.02, 0.1, 0.5, 2.0, 10.0, 60.0)


class Metrics:
    """Requests as they come; jobs and workers as the database has them when asked.

    A registry of its own, so that two applications in one process do not share their numbers.
    """

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._requests = Counter(
            "prtbake_http_requests",
            "Requests answered.",
            ["method", "route", "status"],
            registry=self.registry,
        )
        self._seconds = Histogram(
            "prtbake_http_request_seconds",
            "Time to the end of the answer.",
            ["route"],
            buckets=_BUCKETS,
            registry=self.registry,
        )

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def watch(self, jobs: Callable[[], Mapping[str, int]], workers: Callable[[], int]) -> None:
        """Add gauges that ask for jobs by state and living workers at each scrape."""
        self.registry.register(_RecordsCollector(jobs, workers))

    def render(self) -> bytes:
        """Write everything in the text format."""
        return generate_latest(self.registry)


class _RecordsCollector(Collector):
    def __init__(self, jobs: Callable[[], Mapping[str, int]], workers: Callable[[], int]) -> None:
        self._jobs = jobs
        self._workers = workers

    def describe(self) -> Iterator[Metric]:
        # named here, so that registering asks the database for nothing
        yield GaugeMetricFamily("prtbake_jobs", "Jobs by state.", labels=["state"])
        yield GaugeMetricFamily("prtbake_workers_alive", "Workers with a fresh heartbeat.")

    def collect(self) -> Iterator[Metric]:
        jobs = GaugeMetricFamily("prtbake_jobs", "Jobs by state.", labels=["state"])
        for state, count in self._jobs().items():
            jobs.add_metric([state], count)
        yield jobs
        yield GaugeMetricFamily(
            "prtbake_workers_alive", "Workers with a fresh heartbeat.", value=self._workers()
        )
