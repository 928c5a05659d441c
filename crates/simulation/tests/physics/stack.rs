//! The stack size that a simulation needs.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

use crate::common;

use std::thread;

use messages::Latched;
use simulation::Simulation;

/// Less than the 2 MB of a Rust thread, because the caller has used some of it.
const STACK_BYTES: usize = 3 << 19;

const SCENES: [&str; 5] = [
    "name = \"planar\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\n",
    "name = \"arc\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\n\
     manipulator = { model = \"constant_curvature\" }\n",
    "name = \"modes\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\n\
     manipulator = { model = \"modal\" }\n",
    "name = \"full\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\n\
     manipulator = { model = \"full\", links = 27 }\n",
    "name = \"bodies\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\n\
     manipulator = { model = \"spatial\", links = 8 }\n\
     [[body]]\nname = \"fragment\"\ncuboid = { half_extents_mm = [8.0, 8.0, 4.0] }\nmotion = \"free\"\n\
     position_mm = [1.0, 0.5, 7.6]\n",
];

/// A simulation has 105 kB, and constructing it takes several times that. Callers that keep several box each
/// one as it is constructed: an array of four took more than the 2 MB of a thread.
#[test]
fn simulations_are_built_stepped_and_restored_in_a_small_stack() {
    let work = || {
        let make = |text| Box::new(Simulation::new(&common::scene(text), None).unwrap());
        let mut all: Vec<_> = SCENES.into_iter().map(make).collect();
        let saved: Vec<_> = all.iter().map(|simulation| simulation.snapshot()).collect();
        let mut buffer = vec![0; 1 << 20];
        for (simulation, saved) in all.iter_mut().zip(&saved) {
            for tick in 0..10 {
                simulation.step(&Latched { tick, ..Latched::zeroed() }).unwrap();
            }
            let hash = simulation.state().hash;
            let length = simulation.write_keyframe(&mut buffer).unwrap();
            simulation.restore(saved).unwrap();
            simulation.restore_keyframe(&buffer[..length]).unwrap();
            assert_eq!(simulation.state().hash, hash);
        }
    };
    thread::Builder::new().stack_size(STACK_BYTES).spawn(work).unwrap().join().unwrap();
}
