#!/bin/bash
# A campaign on a Ray cluster that lives as long as this Slurm job. From the folder that holds the campaign:
#
#   sbatch slurm_ray.sh campaign.yaml runs/campaign
#
# Options of `harness run` may follow: --set stop.rhw=0.2. When the job is started again (--requeue, or by you), it goes on.
#SBATCH --job-name=harness
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --mem-per-cpu=1G
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=harness-%j.log
set -euo pipefail

campaign=${1:?campaign file} out=${2:?run folder}
shift 2
# Others have jobs on these machines, too: only who knows the token may use the cluster.
RAY_AUTH_TOKEN=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
RAY_AUTH_MODE=token
port=$((20000 + SLURM_JOB_ID % 10000)) # two jobs may share a machine
RAY_ADDRESS=$(hostname --ip-address | cut -d ' ' -f 1):$port
export RAY_AUTH_TOKEN RAY_AUTH_MODE RAY_ADDRESS

ray start --head --port="$port" --num-cpus="$SLURM_CPUS_PER_TASK" --disable-usage-stats
if [[ $SLURM_JOB_NUM_NODES -gt 1 ]]; then # the others, each until the job ends
    srun --nodes=$((SLURM_JOB_NUM_NODES - 1)) --ntasks=$((SLURM_JOB_NUM_NODES - 1)) --exclude="$SLURMD_NODENAME" \
        ray start --address="$RAY_ADDRESS" --num-cpus="$SLURM_CPUS_PER_TASK" --block &
fi
# The machines come one after another: workers start where there is room. exec: SIGTERM reaches harness.
exec harness run "$campaign" "$@" --out "$out" --executor ray --resume --workers $((SLURM_JOB_NUM_NODES * SLURM_CPUS_PER_TASK))
