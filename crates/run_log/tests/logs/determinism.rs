//! The file's bytes are a function of the sequence of messages.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use crate::common::*;
use fastrand::Rng;
use messages::layout::hex;
use proptest::prelude::*;
use run_log::ReadOptions;
use run_log::diff::diff;
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

/// The recorder may drain its queues in any order.
fn interleaved(steps: &[Step], choices: &[u8]) -> Vec<Step> {
    let of = |kind: fn(&Step) -> bool| steps.iter().filter(|s| kind(s)).cloned().collect::<Vec<_>>();
    let mut queues = [
        of(|s| matches!(s, Step::Latched(_))),
        of(|s| matches!(s, Step::Removed(_))),
        of(|s| matches!(s, Step::State(_))),
        of(|s| matches!(s, Step::Reply(_))),
        of(|s| matches!(s, Step::Frame(_))),
    ];
    queues.iter_mut().for_each(|queue| queue.reverse());
    let mut out = Vec::new();
    let mut choice = choices.iter().cycle();
    while queues.iter().any(|queue| !queue.is_empty()) {
        let c = *choice.next().unwrap();
        for _ in 0..=(c / 5) {
            out.extend(queues[usize::from(c % 5)].pop());
        }
    }
    out
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]
    /// However the recorder drains its queues, the file is the same.
    #[test]
    fn the_turn_of_the_queues_does_not_matter(
        mut choices in prop::collection::vec(any::<u8>(), 1..40),
        reset in prop::option::of(1u64..299),
    ) {
        choices.extend([0, 1, 2, 3, 4]);
        let steps = run_messages(300, reset);
        prop_assert_eq!(digest(&write_log(&steps)), digest(&write_log(&interleaved(&steps, &choices))));
    }
}

/// Delays frames and their replies by some ticks after the tick that each shows.
fn delayed(steps: &[Step], mut ticks: impl FnMut() -> u64) -> Vec<Step> {
    let (mut tick, mut out, mut waiting) = (0, Vec::new(), std::collections::VecDeque::new());
    for step in steps {
        if matches!(step, Step::Reply(_) | Step::Frame(_)) {
            waiting.push_back((tick + ticks(), step.clone()));
            continue;
        }
        out.push(step.clone());
        if let Step::State(state) = step {
            tick = state.tick;
            while waiting.front().is_some_and(|(due, _)| *due <= tick) {
                out.extend(waiting.pop_front().map(|(_, step)| step));
            }
        }
    }
    out.extend(waiting.into_iter().map(|(_, step)| step));
    out
}

/// Rendering times of up to 300 ms do not show in the file; with longer ones the file differs, but the run is
/// the same.
#[test]
fn the_speed_of_the_renderer_does_not_matter() {
    let steps = run_messages(2000, None);
    let prompt = write_log(&steps);
    let mut random = Rng::with_seed(8);
    for most in [1, 40, 299] {
        let slow = delayed(&steps, || random.u64(..) % most);
        assert_eq!(digest(&prompt), digest(&write_log(&slow)), "up to {most} ticks late");
    }
    let late = write_log(&delayed(&steps, || 700));
    assert_ne!(digest(&prompt), digest(&late));
    let (a, b) = (named("a", &prompt), named("b", &late));
    let report = diff(&a, &b, ReadOptions::default()).unwrap();
    assert_eq!((report.same_run(), report.identical_ticks, report.identical_frames), (true, 2000, 50));
}
