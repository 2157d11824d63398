"""A Dask scheduler and its worker in one process, for test_map_cluster.py: prints its address, stays until killed."""

import sys
import time

import distributed
from distributed.security import Security

if __name__ == "__main__":
    security = Security()  # from the environment, as the client has it
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tls://", security=security,
        dashboard_address=None, silence_logs=50,
    ) as cluster:  # fmt: skip
        sys.stdout.write(f"{cluster.scheduler_address}\n")
        sys.stdout.flush()
        time.sleep(600)
