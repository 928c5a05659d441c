//! The file's bytes are a function of the message sequence.
#![allow(missing_docs)]

mod common;
use common::*;
use ipc_types::layout::hex;
use proptest::prelude::*;
use sha2::{Digest, Sha256};

fn digest(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

#[test]
fn the_same_messages_make_the_same_file() {
    let steps = run_messages(1500, Some(700));
    let (a, b) = (write_log(&steps), write_log(&steps));
    println!("SHA-256 {} of {} bytes", digest(&a), a.len());
    assert_eq!(digest(&a), digest(&b));
    let mut other = steps.clone();
    if let Step::State(state) = &mut other[1000] {
        state.bend_rad += 1e-300;
    } else if let Step::Latched(latched) = &mut other[1000] {
        latched.commands[0].command.arm_speed_m_per_s += 1e-300;
    }
    assert_ne!(digest(&a), digest(&write_log(&other)));
}

/// Queues of the physics: `Latched`, `Removed` and `State` may be emptied in any turn.
fn interleaved(steps: &[Step], choices: &[u8]) -> Vec<Step> {
    let of = |kind: fn(&Step) -> bool| steps.iter().filter(|s| kind(s)).cloned().collect::<Vec<_>>();
    let mut queues = [
        of(|s| matches!(s, Step::Latched(_))),
        of(|s| matches!(s, Step::Removed(_))),
        of(|s| matches!(s, Step::State(_))),
    ];
    queues.iter_mut().for_each(|queue| queue.reverse());
    let mut out = Vec::new();
    let mut choice = choices.iter().cycle();
    while queues.iter().any(|queue| !queue.is_empty()) {
        let c = *choice.next().unwrap();
        for _ in 0..=(c / 3) {
            out.extend(queues[usize::from(c % 3)].pop());
        }
    }
    out
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// However the recorder drains its queues, the file is the same.
    #[test]
    fn the_turn_of_the_queues_does_not_matter(
        mut choices in prop::collection::vec(any::<u8>(), 1..40),
        reset in prop::option::of(1u64..299),
    ) {
        choices.extend([0, 1, 2]);
        let steps: Vec<Step> =
            run_messages(300, reset).into_iter().filter(|s| !matches!(s, Step::Reply(_) | Step::Frame(_))).collect();
        prop_assert_eq!(digest(&write_log(&steps)), digest(&write_log(&interleaved(&steps, &choices))));
    }
}
