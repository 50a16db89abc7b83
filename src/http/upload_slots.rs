//! Who receives submissions at the same time: a bounded number, of which no client can have all.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::access::Client;

/// Slots for submissions that are being received.
///
/// Each client may have a quarter of them, and more only while half of all are free: so one that fills what it may leaves others their part.
pub(crate) struct UploadSlots {
    count: usize,
    taken: Mutex<BTreeMap<Client, usize>>,
}

/// A slot, until it is dropped.
pub(crate) struct UploadSlot {
    slots: Arc<UploadSlots>,
    client: Client,
}

impl UploadSlots {
    pub(crate) fn new(count: usize) -> Arc<Self> {
        Arc::new(UploadSlots { count, taken: Mutex::new(BTreeMap::new()) })
    }

    /// A slot for a client, which may have `most`; `None` where it must come back later.
    pub(crate) fn take(self: &Arc<Self>, client: Client, most: Option<u32>) -> Option<UploadSlot> {
        let mut taken = self.lock();
        let free = self.count.saturating_sub(taken.values().sum());
        let own = taken.get(&client).copied().unwrap_or(0);
        if free == 0 || (own >= (self.count / 4).max(1) && free <= self.count / 2) {
            return None;
        }
        if most.is_some_and(|most| own >= most as usize) {
            return None;
        }
        *taken.entry(client.clone()).or_insert(0) += 1;
        Some(UploadSlot { slots: self.clone(), client })
    }

    /// Slots that a client has.
    pub(crate) fn taken_by(&self, client: &Client) -> usize {
        self.lock().get(client).copied().unwrap_or(0)
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Client, usize>> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for UploadSlot {
    fn drop(&mut self) {
        let mut taken = self.slots.lock();
        if let Some(own) = taken.get_mut(&self.client) {
            *own -= 1;
            if *own == 0 {
                taken.remove(&self.client);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ip(text: &str) -> Client {
        Client::of(text.parse().unwrap())
    }

    #[test]
    fn no_client_has_all_slots_and_each_has_its_part() {
        let slots = UploadSlots::new(32);
        let take =
            |address: &str| -> Vec<UploadSlot> { std::iter::from_fn(|| slots.take(ip(address), None)).collect() };
        let greedy = take("10.0.0.1");
        assert_eq!(greedy.len(), 16);
        let (second, third) = (take("2001:db8::1"), take("10.0.0.3"));
        assert_eq!((second.len(), third.len()), (8, 8));
        assert!(slots.take(ip("10.0.0.4"), None).is_none(), "all are taken");
        drop(third);
        assert!(slots.take(ip("2001:db8::2"), None).is_none(), "the same network is the same client");
        assert!(slots.take(ip("10.0.0.4"), None).is_some());
        drop((greedy, second));
        assert!(slots.lock().is_empty());
    }

    #[test]
    fn few_slots_serve_everybody() {
        let slots = UploadSlots::new(1);
        let first = slots.take(ip("10.0.0.1"), None);
        assert!(first.is_some() && slots.take(ip("10.0.0.2"), None).is_none());
        drop(first);
        assert!(slots.take(ip("10.0.0.2"), None).is_some());
        let slots = UploadSlots::new(8);
        let tenant = || Client::Tenant("studio".to_owned());
        let first = slots.take(tenant(), Some(1));
        assert!(first.is_some() && slots.take(tenant(), Some(1)).is_none() && slots.take(tenant(), None).is_some());
        assert_eq!(slots.taken_by(&tenant()), 1);
        assert!(UploadSlots::new(0).take(ip("10.0.0.1"), None).is_none());
    }
}
