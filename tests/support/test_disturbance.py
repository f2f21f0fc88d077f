"""What the tests of disturbances measure by."""

import subprocess
import sys
import time

import psutil

from support.disturbance import seconds_to_free


def test_the_time_that_a_cancellation_takes_to_answer_counts() -> None:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])

    def cancel_slowly() -> None:
        process.kill()
        time.sleep(0.3)  # the CPU is free long before the answer comes

    assert 0.3 <= seconds_to_free(cancel_slowly, [psutil.Process(process.pid)]) < 10.0
    process.wait()
