//! Pareto fronts of two objectives.

/// Returns the indices of the points that no other point beats in both coordinates, both to be minimised, by
/// the first coordinate. Of equal points, the first one is kept. Points that are not finite are left out.
pub fn pareto_front(points: &[[f64; 2]]) -> Vec<usize> {
    let mut order = sorted(points);
    let mut least = f64::INFINITY;
    order.retain(|index| {
        let is_better = points[*index][1] < least;
        least = least.min(points[*index][1]);
        is_better
    });
    order
}

/// Returns the indices of the finite points by their coordinates; equal points keep their order.
fn sorted(points: &[[f64; 2]]) -> Vec<usize> {
    let is_finite = |index: &usize| points[*index].iter().all(|x| x.is_finite());
    let mut order: Vec<usize> = (0..points.len()).filter(is_finite).collect();
    let by_first = |a: &usize, b: &usize| {
        let [a, b] = [points[*a], points[*b]];
        a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1]))
    };
    order.sort_by(by_first);
    order
}

/// Returns the indices of all finite points, front by front: the Pareto front, then the front of the rest,
/// and so on (non-dominated sorting, Srinivas and Deb 1994, doi 10.1162/evco.1994.2.3.221).
pub fn pareto_order(points: &[[f64; 2]]) -> Vec<usize> {
    // Sorting what is sorted takes linear time.
    let mut left = sorted(points);
    let mut order = Vec::with_capacity(points.len());
    loop {
        let rest: Vec<[f64; 2]> = left.iter().map(|index| points[*index]).collect();
        let front = pareto_front(&rest);
        if front.is_empty() {
            return order;
        }
        order.extend(front.iter().map(|index| left[*index]));
        let mut is_taken = vec![false; left.len()];
        front.iter().for_each(|index| is_taken[*index] = true);
        left = left.into_iter().zip(is_taken).filter(|(_, taken)| !taken).map(|(index, _)| index).collect();
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Whether `a` is no worse than `b` in both coordinates and better in one.
    fn beats(a: [f64; 2], b: [f64; 2]) -> bool {
        a[0] <= b[0] && a[1] <= b[1] && a != b
    }

    fn point() -> impl Strategy<Value = [f64; 2]> {
        [0..12_i32, 0..12].prop_map(|point| point.map(f64::from))
    }

    proptest! {
        /// Few values, so that many coordinates are equal.
        #[test]
        fn the_front_is_that_of_all_pairs(
            points in proptest::collection::vec(point(), 0..60),
        ) {
            let is_first = |index: usize| !points[..index].contains(&points[index]);
            let is_beaten = |index: usize| points.iter().any(|other| beats(*other, points[index]));
            let mut expected: Vec<usize> =
                (0..points.len()).filter(|index| is_first(*index) && !is_beaten(*index)).collect();
            expected.sort_by(|a, b| points[*a][0].total_cmp(&points[*b][0]));
            prop_assert_eq!(pareto_front(&points), expected);
            // No point comes after one that it beats, and each comes once.
            let order = pareto_order(&points);
            for (place, index) in order.iter().enumerate() {
                prop_assert!(!order[place..].iter().any(|later| beats(points[*later], points[*index])));
            }
            let mut all = order;
            all.sort_unstable();
            prop_assert_eq!(all, (0..points.len()).collect::<Vec<usize>>());
        }
    }

    #[test]
    fn what_is_not_a_number_is_left_out() {
        let points = [[f64::NAN, 0.0], [1.0, 2.0], [0.0, f64::INFINITY], [2.0, 1.0]];
        assert_eq!(pareto_front(&points), [1, 3]);
        assert_eq!(pareto_order(&points), [1, 3]);
    }
}
