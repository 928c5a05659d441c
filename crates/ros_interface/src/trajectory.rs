//! Trajectories of the arm's joints: points with their times.

use messages::MAX_ARM_JOINTS;

/// Joint angles at a time after the trajectory's start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Waypoint {
    /// Time after the start, s.
    pub time_s: f64,
    /// Joint angles, rad.
    pub joints_rad: [f64; MAX_ARM_JOINTS],
}

/// A checked trajectory: at least one point, with times from zero on that increase.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    points: Vec<Waypoint>,
}

impl Trajectory {
    /// Returns the trajectory of these points; `None` without points, or if a time is negative or does not
    /// exceed the one before.
    pub fn new(points: Vec<Waypoint>) -> Option<Trajectory> {
        // The first point may be the start, as in plans of MoveIt.
        let mut before_s = -f64::MIN_POSITIVE;
        let increases =
            points.iter().all(|point| point.time_s > std::mem::replace(&mut before_s, point.time_s));
        (increases && !points.is_empty()).then_some(Trajectory { points })
    }

    /// Returns the joint angles at a time after the start, on straight lines in joint space from `start_rad`
    /// through the points.
    pub fn at(&self, start_rad: &[f64; MAX_ARM_JOINTS], time_s: f64) -> [f64; MAX_ARM_JOINTS] {
        let mut from = Waypoint { time_s: 0.0, joints_rad: *start_rad };
        for to in &self.points {
            if time_s < to.time_s {
                let share = ((time_s - from.time_s) / (to.time_s - from.time_s)).max(0.0);
                let between = |joint: usize| {
                    from.joints_rad[joint] + share * (to.joints_rad[joint] - from.joints_rad[joint])
                };
                return core::array::from_fn(between);
            }
            from = *to;
        }
        from.joints_rad
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(time_s: f64, angle_rad: f64) -> Waypoint {
        Waypoint { time_s, joints_rad: [angle_rad; MAX_ARM_JOINTS] }
    }

    #[test]
    fn points_are_passed_at_their_times_on_straight_lines_and_the_last_one_is_held() {
        let trajectory = Trajectory::new(vec![point(1.0, 0.5), point(3.0, -0.5)]).unwrap();
        let start_rad = [0.1; MAX_ARM_JOINTS];
        for (time_s, expected) in [(0.0, 0.1), (0.5, 0.3), (1.0, 0.5), (2.0, 0.0), (3.0, -0.5), (9.0, -0.5)] {
            let joints = trajectory.at(&start_rad, time_s);
            assert!((joints[6] - expected).abs() < 1e-15, "{time_s}: {joints:?}");
        }
    }

    #[test]
    fn times_must_increase() {
        for points in [
            vec![],
            vec![point(-1.0, 0.0)],
            vec![point(1.0, 0.0), point(1.0, 0.1)],
            vec![point(f64::NAN, 0.0)],
        ] {
            assert_eq!(Trajectory::new(points), None);
        }
        let from_start = Trajectory::new(vec![point(0.0, 0.2), point(1.0, 0.4)]).unwrap();
        assert!((from_start.at(&[9.0; MAX_ARM_JOINTS], 0.5)[0] - 0.3).abs() < 1e-15);
    }
}
