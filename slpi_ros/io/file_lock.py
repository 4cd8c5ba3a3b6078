"""Locks of files and folders, which end with the process that holds them, however that ends."""

import fcntl


def lock(descriptor: int, *, shared: bool = False) -> bool:
    """Lock an open file or folder; return False if another process holds a lock on it that this one excludes.

    A `shared` lock excludes exclusive ones only: it asks whether there is one. Some network file systems have no locks:
    there nobody is excluded.
    """
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True
