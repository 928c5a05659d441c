//! Work on all cores.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Returns the results of all items in their order, or the first failure, after which no item is begun. The
/// threads are its own: a simulation waits for its X-ray frames in rayon's pool, whose threads would begin
/// others meanwhile, one on top of the other. `name` names them.
///
/// # Errors
/// As `of`.
pub fn on_all_cores<T: Sync, R: Send, E: Send>(
    name: &str,
    items: &[T],
    of: impl Fn(&T) -> Result<R, E> + Sync,
) -> Result<Vec<R>, E> {
    let next = AtomicUsize::new(0);
    let results: Mutex<Vec<Option<R>>> = Mutex::new(items.iter().map(|_| None).collect());
    let failure = Mutex::new(None);
    let work = || {
        while let Some((index, item)) = {
            let index = next.fetch_add(1, Ordering::Relaxed);
            items.get(index).map(|item| (index, item))
        } {
            match of(item) {
                Ok(result) => results.lock().unwrap_or_else(PoisonError::into_inner)[index] = Some(result),
                Err(error) => {
                    failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                    next.store(items.len(), Ordering::Relaxed);
                }
            }
        }
    };
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    std::thread::scope(|scope| {
        for number in 1..cores.min(items.len()) {
            let thread = std::thread::Builder::new().name(format!("{name}-{number}"));
            // With fewer threads the work takes longer, and its results are the same.
            let _ = thread.spawn_scoped(scope, work);
        }
        work();
    });
    match failure.into_inner().unwrap_or_else(PoisonError::into_inner) {
        Some(failure) => Err(failure),
        None => {
            Ok(results.into_inner().unwrap_or_else(PoisonError::into_inner).into_iter().flatten().collect())
        }
    }
}
