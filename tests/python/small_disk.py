"""A disk that is full after so many bytes: a tmpfs, or where nothing may be mounted a limit of the size of files."""

import contextlib
import ctypes
import os
import resource
import signal

PAGE = 4096
LIBC = ctypes.CDLL(None, use_errno=True)


def _mount(folder, size):
    options = f"size={size}".encode()
    return LIBC.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 0, options) == 0


@contextlib.contextmanager
def file_size_limit(most):
    """No file may be larger; Python ignores the signal that comes with it."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def limit_of_a_child(most):
    """For subprocess.run(preexec_fn=...)."""

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    return limit


class SmallDisk:
    """A folder on a disk of its own."""

    def __init__(self, folder, size):
        self.folder = folder
        self.size = size
        folder.mkdir()
        self.mounted = _mount(folder, size)
        if not self.mounted:
            print("no tmpfs could be mounted here: a limit of the size of files takes its place")
        self._filler = folder / "filler"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.mounted and LIBC.umount2(os.fsencode(self.folder), 2) != 0:  # MNT_DETACH
            raise OSError(ctypes.get_errno(), "umount")

    @contextlib.contextmanager
    def leaving(self, pages):
        """While so many pages are free."""
        if not self.mounted:
            with file_size_limit(pages * PAGE):
                yield
            return
        self._filler.write_bytes(b"")
        status = os.statvfs(self.folder)
        with open(self._filler, "wb") as file:
            for _ in range(status.f_bavail - pages):
                file.write(bytes(PAGE))
        assert os.statvfs(self.folder).f_bavail == pages
        try:
            yield
        finally:
            self._filler.unlink()
