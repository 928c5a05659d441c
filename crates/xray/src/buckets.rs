//! Counting sort.

/// Sorts values by their bucket, 0 to `buckets - 1`, and keeps their order within each: those of bucket i are
/// then `sorted[starts[i]..starts[i + 1]]`. Both vectors are reused, so sorting as many values again
/// allocates nothing.
pub(crate) fn sort_into_buckets<T: Copy + Default>(
    values: impl Iterator<Item = (usize, T)> + Clone,
    buckets: usize,
    starts: &mut Vec<usize>,
    sorted: &mut Vec<T>,
) {
    starts.clear();
    starts.resize(buckets + 1, 0);
    for (bucket, _) in values.clone() {
        starts[bucket + 1] += 1;
    }
    for i in 1..starts.len() {
        starts[i] += starts[i - 1];
    }
    sorted.clear();
    sorted.resize(starts[buckets], T::default());
    // Filling a bucket moves its start to its end, which is the next one's start; shifted back below.
    for (bucket, value) in values {
        let at = &mut starts[bucket];
        sorted[*at] = value;
        *at += 1;
    }
    starts.rotate_right(1);
    starts[0] = 0;
}
