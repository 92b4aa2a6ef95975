"""Waits that should have no end, in a library compiled as Fast DDS is in the wheels."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

# What std::condition_variable::wait_until(steady_clock::time_point::max()) becomes with libstdc++ 9: the time is
# negative, the wait is refused at once, with the mutex held, and begun again.
WAITS = """
#include <pthread.h>
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t over = PTHREAD_COND_INITIALIZER;
static int busy = 1;
static void *callback(void *unused) {
    pthread_mutex_lock(&mutex);
    busy = 0;
    pthread_cond_signal(&over);
    pthread_mutex_unlock(&mutex);
    return unused;
}
int refused(void) {
    const struct timespec end = {-7000000000, -5};
    pthread_t thread;
    int times = 0;
    pthread_mutex_lock(&mutex);
    pthread_create(&thread, 0, callback, 0);
    while (busy && times < 1000000) times += pthread_cond_timedwait(&over, &mutex, &end) != 0;
    pthread_mutex_unlock(&mutex);
    pthread_join(thread, 0);
    return times;
}
int late(void) {
    const struct timespec begin = {1, 0};
    pthread_mutex_lock(&mutex);
    const int code = pthread_cond_timedwait(&over, &mutex, &begin);
    pthread_mutex_unlock(&mutex);
    return code;
}
"""
PROGRAM = """
import ctypes, errno, sys
from dtsa_agent.ros.common._endless import mend
library = ctypes.CDLL(sys.argv[1])
assert mend("no such library") == 0
if sys.argv[2] == "mended":
    assert mend("libwaits_of_a_test") == mend("libwaits_of_a_test") == 1
assert library.late() == errno.ETIMEDOUT
print(library.refused())
"""


@pytest.mark.parametrize("now", [False, True])
def test_a_wait_without_an_end_gives_the_mutex_free(tmp_path: Path, now: bool) -> None:
    """With functions bound when they are called first, and with all bound when the library is loaded."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    source, library = tmp_path / "waits.c", tmp_path / "libwaits_of_a_test.so"
    source.write_text(WAITS)
    binding = "-Wl,-z,relro,-z,now" if now else "-Wl,-z,lazy"
    subprocess.run([compiler, "-shared", "-fPIC", binding, "-o", library, source, "-lpthread"], check=True, timeout=60)
    for how, times in (("as it is", "1000000"), ("mended", "0")):
        words = [sys.executable, "-c", PROGRAM, str(library), how]
        done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stdout.strip()) == (0, times), done.stderr


def test_the_middlewares_waits_are_mended_where_it_needs_that() -> None:
    """That of the wheels calls us once ROS has been initialized; that of apt never asks for such a wait."""
    pytest.importorskip("rclpy")
    program = (
        "from pathlib import Path\nfrom dtsa_agent.ros.common.node_process import init_ros\n"
        "from dtsa_agent.ros.common._endless import mend\ninit_ros([])\n"
        "maps = Path('/proc/self/maps').read_text()\n"
        "assert 'libfastrtps' not in maps or mend('libfastrtps') == 1\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
