//! API keys: who may do what, as which tenant, and how much.
//!
//! A token is shown once, when its key is made. It is 256 random bits, so its SHA-256 is all that has to be kept: it cannot be guessed from
//! its hash, and looking up a hash tells nothing by the time that it takes.

use async_trait::async_trait;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use utoipa::ToSchema;

use super::record::{Timestamp, new_id};
use crate::config::{Quotas, Scope};
use crate::error::{Code, Failure, Result};

/// What a token begins with, so that scanners for secrets know one when they see it.
const PREFIX: &str = "intarsia_";
/// Characters of the name of a tenant.
const MAX_TENANT: usize = 64;
/// Characters of the name of a key.
const MAX_NAME: usize = 200;

/// A key, without its token.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, ToSchema)]
pub struct Key {
    /// Its id; tells nothing of the token.
    #[schema(pattern = "^[0-9a-f]{32}$")]
    pub id: String,
    /// What people call it.
    pub name: String,
    /// Whose jobs it works on.
    pub tenant: String,
    /// What it is for.
    pub scopes: Vec<Scope>,
    /// What its tenant may have.
    pub quotas: Quotas,
    /// When it was made.
    pub created_at: Timestamp,
    /// Since when it is worth nothing.
    pub revoked_at: Option<Timestamp>,
}

/// A key to make.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewKey {
    /// Whose jobs it works on.
    #[schema(pattern = "^[A-Za-z0-9._-]{1,64}$")]
    pub tenant: String,
    /// What it is for.
    #[schema(min_items = 1, max_items = 3)]
    pub scopes: Vec<Scope>,
    /// What people call it.
    #[serde(default)]
    #[schema(max_length = 200, default = "")]
    pub name: String,
    /// What its tenant may have.
    #[serde(default)]
    #[schema(required = false)]
    pub quotas: Quotas,
}

impl NewKey {
    /// The key, and its token, which nobody can tell again.
    ///
    /// # Errors
    /// `invalid_options` for a tenant, scopes or a name that cannot be.
    pub fn make(mut self) -> Result<(Key, String)> {
        let invalid = |pointer: &str, why: String| Err(Failure::new(Code::InvalidOptions, why).at(pointer));
        let named = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        if !(1..=MAX_TENANT).contains(&self.tenant.len()) || !self.tenant.chars().all(named) {
            let why = format!("a tenant's name has 1 to {MAX_TENANT} letters, digits, `.`, `_` or `-`");
            return invalid("/tenant", why);
        }
        if self.name.chars().count() > MAX_NAME || self.name.chars().any(char::is_control) {
            let why = format!("a key's name has at most {MAX_NAME} characters, none of them a control character");
            return invalid("/name", why);
        }
        self.scopes.sort_unstable();
        self.scopes.dedup();
        if self.scopes.is_empty() {
            return invalid("/scopes", "a key needs a scope: submit, read or admin".to_owned());
        }
        for (pointer, least) in
            [("/quotas/max_running", self.quotas.max_running), ("/quotas/rate_limit", self.quotas.rate_limit)]
        {
            if least == Some(0) {
                return invalid(pointer, "must be 1 or more; to stop a key, revoke it".to_owned());
            }
        }
        let mut secret = [0; 32];
        getrandom::fill(&mut secret).map_err(|e| Failure::internal(format!("no random bits: {e}")))?;
        let NewKey { tenant, scopes, name, quotas } = self;
        let key = Key { id: new_id()?, name, tenant, scopes, quotas, created_at: Timestamp::now(), revoked_at: None };
        Ok((key, format!("{PREFIX}{}", hex::encode(secret))))
    }
}

/// What is kept of a token.
pub fn hash(token: &str) -> String {
    hex::encode(Sha256::digest(token))
}

/// Where keys are kept. Every method fails with `insufficient_storage` or `unavailable` when the backend does.
#[async_trait]
pub trait KeyStore: Send + Sync {
    /// Stores a key under the hash of its token.
    async fn add_key(&self, key: &Key, hash: &str) -> Result<()>;

    /// The key whose token has that hash, unless it is revoked.
    async fn key_of(&self, hash: &str) -> Result<Option<Key>>;

    /// All keys, the newest first.
    async fn keys(&self) -> Result<Vec<Key>>;

    /// Revokes a key: false when there is none, or when it is revoked already.
    async fn revoke_key(&self, id: &str) -> Result<bool>;
}

#[cfg(test)]
pub(super) mod conformance {
    use super::*;

    /// What every store of keys must do.
    pub(in crate::jobs) async fn suite(store: &impl KeyStore) {
        let made = |tenant: &str| {
            let quotas = Quotas { max_queued: Some(3), ..Quotas::default() };
            let scopes = vec![Scope::Read, Scope::Submit, Scope::Read];
            NewKey { tenant: tenant.into(), scopes, name: "ci".into(), quotas }.make().unwrap()
        };
        let ((first, token), (second, other)) = (made("a"), made("b"));
        assert_ne!(token, other);
        assert_eq!(first.scopes, [Scope::Submit, Scope::Read], "sorted, each once");
        store.add_key(&first, &hash(&token)).await.unwrap();
        store.add_key(&second, &hash(&other)).await.unwrap();
        assert_eq!(store.key_of(&hash(&token)).await, Ok(Some(first.clone())));
        assert_eq!(store.key_of(&token).await, Ok(None), "the token itself is not kept");
        assert_eq!(store.keys().await.unwrap().len(), 2);
        assert_eq!(store.revoke_key(&first.id).await, Ok(true));
        assert_eq!(store.revoke_key(&first.id).await, Ok(false));
        assert_eq!(store.key_of(&hash(&token)).await, Ok(None));
        assert_eq!(store.key_of(&hash(&other)).await, Ok(Some(second)));
        assert!(store.keys().await.unwrap().iter().any(|k| k.id == first.id && k.revoked_at.is_some()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_that_cannot_be_are_told_where() {
        let new = |tenant: &str, scopes: &[Scope], name: &str, quotas: Quotas| {
            let new = NewKey { tenant: tenant.into(), scopes: scopes.into(), name: name.into(), quotas };
            new.make().unwrap_err().pointer.unwrap()
        };
        for tenant in ["", "a b", "ä", "a/b", "a\nb", &"x".repeat(65)] {
            assert_eq!(new(tenant, &[Scope::Read], "", Quotas::default()), "/tenant", "{tenant:?}");
        }
        assert_eq!(new("a", &[], "", Quotas::default()), "/scopes");
        assert_eq!(new("a", &[Scope::Read], "a\tb", Quotas::default()), "/name");
        let none = Quotas { rate_limit: Some(0), ..Quotas::default() };
        assert_eq!(new("a", &[Scope::Read], "", none), "/quotas/rate_limit");
    }
}
