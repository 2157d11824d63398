"""A campaign on a Slurm cluster: workers are Slurm jobs, scheduler and campaign run in this process.

    python slurm_campaign.py campaign.yaml --keep /shared/outcomes [more options of `aerpaw-cmp campaign`]

Run it where `sbatch` works (a login node, or a small job of its own). The environment of this Python and the files of
the campaign must have the same paths on each node. Set queue, account, memory and time in SLURM_CAMPAIGN_..., or change
the lines below.
"""

import os
import subprocess
import sys
from pathlib import Path

from dask_jobqueue import SLURMCluster
from distributed.security import Security


def main() -> int:
    """Start the workers, run the campaign, end the workers, and return the campaign's exit code."""
    asked = os.environ
    security = Security.temporary()  # anyone who reaches a scheduler without TLS can run programs as you
    with SLURMCluster(
        security=security,
        protocol="tls://",
        shared_temp_directory=asked.get("SLURM_CAMPAIGN_SHARED", str(Path.home())),  # certificates
        queue=asked.get("SLURM_CAMPAIGN_QUEUE"),
        account=asked.get("SLURM_CAMPAIGN_ACCOUNT"),
        cores=1,
        memory=asked.get("SLURM_CAMPAIGN_MEMORY", "4GB"),
        walltime=asked.get("SLURM_CAMPAIGN_TIME", "04:00:00"),
        interface=asked.get("SLURM_CAMPAIGN_INTERFACE"),  # the network that nodes and login node share, e.g. ib0
        python=sys.executable,
        # the nodes get this environment: PATH, PYTHONPATH
        job_extra_directives=["--export=ALL"],
        job_script_prologue=["export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1"],
        scheduler_options={"dashboard_address": "127.0.0.1:0"},
        worker_extra_args=["--dashboard-address", "127.0.0.1:0"],
    ) as cluster:
        if "--show-job" in sys.argv:
            print(cluster.job_script())
            return 0
        cluster.adapt(minimum_jobs=1, maximum_jobs=int(asked.get("SLURM_CAMPAIGN_JOBS", "40")))
        cluster.wait_for_workers(1)
        command = [sys.executable, "-m", "aerpaw_cmp", "campaign", *sys.argv[1:]]
        tls = "DASK_DISTRIBUTED__COMM__TLS__"
        keys = {
            f"{tls}CA_FILE": security.tls_ca_file,
            f"{tls}CLIENT__CERT": security.tls_client_cert,
            f"{tls}CLIENT__KEY": security.tls_client_key,
        }
        line = [*command, "--scheduler", cluster.scheduler_address]
        return subprocess.run(line, env={**asked, **keys}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
