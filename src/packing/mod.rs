//! packing.
