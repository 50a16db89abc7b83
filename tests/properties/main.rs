//! What must hold whatever comes in: every input is answered, soon, in bounded memory, without a panic.
//!
//! `INTARSIA_FUZZ=1000000` runs a million cases instead of some thousands, `INTARSIA_FUZZ_FROM=N` begins at case N, so
//! that `INTARSIA_FUZZ_FROM=N INTARSIA_FUZZ=1` runs one again, and `INTARSIA_FUZZ_SAVE=FOLDER` writes its files there.

mod fixture;
mod fuzz;
mod guard;
mod hostile;
mod mutate;
mod uploads;
