#!/bin/bash
# A campaign as a Slurm job array: each of 64 tasks runs a part of its tests. From the folder that holds the campaign:
#
#   job=$(sbatch --parsable slurm_parts.sh campaign.yaml runs/campaign)
#   sbatch --dependency=afterok:"$job" --wrap 'harness merge runs/campaign.parts/* --out runs/campaign'
#
# Options of `harness run` may follow, the same for all parts: --set stop.episodes=1e6. If merge misses parts 7, 12 and
# 13, `sbatch --array=7,12-13 slurm_parts.sh campaign.yaml runs/campaign` runs these, or goes on with them.
#
# Shells are planned first, by one task of many cores; the plan then takes the campaign's place, and is merged, too:
#
#   plan=$(sbatch --parsable --requeue --cpus-per-task=64 --mem-per-cpu=1G \
#       --wrap 'exec harness plan campaign.yaml --out runs/campaign.plan --resume --workers 64')
#   job=$(sbatch --parsable --dependency=afterok:"$plan" slurm_parts.sh runs/campaign.plan runs/campaign)
#   sbatch --dependency=afterok:"$job" \
#       --wrap 'exec harness merge runs/campaign.plan runs/campaign.parts/* --out runs/campaign'
#SBATCH --job-name=harness
#SBATCH --array=1-64
#SBATCH --cpus-per-task=4
#SBATCH --mem-per-cpu=1G
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=harness-%A-%a.log
set -euo pipefail

PARTS=64 # of the whole array. Not SLURM_ARRAY_TASK_COUNT: that is 3 when three of them are run again.

campaign=${1:?campaign file} out=${2:?run folder}
shift 2
[ -d "$campaign" ] || set -- --set stop.rhw=null "$@" # a plan has a number of tests
# exec: SIGTERM, at the time limit or when it is preempted, reaches harness, which keeps what is finished.
exec harness run "$campaign" "$@" \
    --part "$SLURM_ARRAY_TASK_ID/$PARTS" --out "$out.parts/$SLURM_ARRAY_TASK_ID" \
    --resume --workers "${SLURM_CPUS_PER_TASK:-1}"
