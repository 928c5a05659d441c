#!/bin/sh
# Runs a sweep as a Slurm array of 16 jobs: sbatch --array=0-15 slurm.sh TRABECULA STUDY FOLDER
# Each job runs a sixteenth of the points; a requeued job continues where it stopped. FOLDER must be on a file system
# shared by all nodes.
#SBATCH --cpus-per-task=2
#SBATCH --requeue
set -eu
exec "$1" sweep run "$2" -o "$3" --quiet --jobs "${SLURM_CPUS_PER_TASK:-1}" \
    --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT"
