//! Prints what packing reaches on every model at hand.

fn main() {}
