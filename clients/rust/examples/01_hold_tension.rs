//! Holds 5 N on tendon 0 and prints the tip position.
//!
//! `trabecula run clients/scenes/free_space.toml`, and in another terminal `cargo run --release -p
//! trabecula_client --example 01_hold_tension`.

use trabecula_client::{ClientError, Command, State, TENDON_SERVO_JF};

fn main() -> Result<(), ClientError> {
    trabecula_client::run(|state: &State, command: &mut Command| {
        if state.tick.is_multiple_of(200) {
            let [x, y, z] = state.t_world_tip.position_m.map(|metres| metres * 1e3);
            println!("tick {:4}  tip {x:8.3} {y:8.3} {z:8.3} mm", state.tick);
        }
        command.tendon_mode = TENDON_SERVO_JF;
        command.tendon_force_n[0] = 5.0;
    })
}
