//! Differences as text.

use messages::Tick;
use messages::layout::Message;
use run_log::Topic;
use run_log::difference::{Divergence, compare};
use zerocopy::IntoBytes;

/// Regression: `data[4711]: 17 against 18` did not tell that the differing messages were keyframes.
#[test]
fn two_keyframes_that_differ_say_that_the_saved_simulation_does() {
    let keyframe = |data: [u8; 4]| {
        let head =
            messages::Keyframe { tick: 500, total_bytes: 4, data_length: 4, ..messages::Keyframe::zeroed() };
        [head.as_bytes(), &data].concat()
    };
    let differ = |a: [u8; 4], b: [u8; 4]| -> Option<Divergence> {
        compare(Topic::Keyframe, Tick(500), messages::Keyframe::DESCRIPTION, &keyframe(a), &keyframe(b))
    };
    assert_eq!(differ([1, 2, 3, 4], [1, 2, 3, 4]), None);
    let said = differ([1, 2, 3, 4], [1, 7, 3, 8]).unwrap().to_string();
    assert!(said.contains("tick 500") && said.contains("the keyframe differs in 2 bytes"), "{said}");
    assert!(said.contains("data[1]") && !said.contains("against"), "{said}");
}
