use super::MAX_TENDONS;
use crate::message;

message! {
    /// Jacobian and compliance of the tip at the present state. Published before the state of the tick, and
    /// only with `manipulator.tip_jacobian`. Not recorded: it follows from the state, and a replay in
    /// `trabecula.sim` computes it again.
    /// At rest near the state: bone and pressing contacts stay as they are, without friction; tendons keep
    /// their sliding state. Matrices are row by row, world axes. Rows are the tip's linear, then angular
    /// velocity, at the origin of `State.t_world_tip`.
    pub struct TipJacobian = "trabecula_msgs/msg/TipJacobian" {
        /// `State.tick` of the state.
        tick: u64,
        /// 6 x 4: velocity of the tip per rate of each tendon's tension, m/N and rad/N; 0 without the tendon.
        per_tension: [f64; 6 * MAX_TENDONS],
        /// 6 x 6: velocity of the tip per linear, then angular velocity of the tool base at the origin of
        /// `State.t_world_base`.
        per_base: [f64; 36],
        /// 6 x 6: displacement of the tip per force, then torque on it, at constant tensions and a fixed
        /// base: m/N, m/(N m), rad/N and rad/(N m).
        compliance: [f64; 36],
    }
}
