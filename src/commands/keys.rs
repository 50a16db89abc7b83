//! `intarsia keys`: the API keys of a service, which may be running.

use intarsia::config::{Keys, KeysCommand};
use intarsia::error::{Code, Failure, Result};
use intarsia::jobs::keys::{Key, NewKey, hash};
use intarsia::jobs::queue::open::{FILE, open};
use serde_json::json;

/// Does it with the queue of the service; makes a data folder where there is none, for the first key.
pub fn run(arguments: &Keys) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    runtime.map_err(|e| Failure::internal(format!("no runtime: {e}")))?.block_on(with_store(arguments))
}

async fn with_store(arguments: &Keys) -> Result<()> {
    let folder = &arguments.data_dir;
    if arguments.queue.postgres()?.is_some() {
        // The data folder has nothing to say.
    } else if let KeysCommand::Create { .. } = arguments.command {
        let failed = |e| Failure::new(Code::InvalidRequest, format!("cannot make {}: {e}", folder.display()));
        std::fs::create_dir_all(folder).map_err(failed)?;
    } else if !folder.join(FILE).exists() {
        let message = format!("{} holds no {FILE}; --data-dir names the service's folder", folder.display());
        return Err(Failure::new(Code::InvalidRequest, message));
    }
    let store = open(&arguments.queue, folder, None).await?.keys;
    match arguments.command.clone() {
        KeysCommand::Create { tenant, scope, name, quotas } => {
            let (key, token) = NewKey { tenant, scopes: scope, name, quotas }.make()?;
            store.add_key(&key, &hash(&token)).await?;
            eprintln!("key {} of tenant {} ({}); its token is shown this once:", key.id, key.tenant, scopes(&key));
            super::print(&format!("{token}\n"))
        }
        KeysCommand::List { json } => {
            let keys = store.keys().await?;
            if json {
                return super::print(&super::pretty(&json!({ "keys": keys })));
            }
            let line = |key: &Key| {
                let state = key.revoked_at.map_or("valid".to_owned(), |at| format!("revoked {at}"));
                format!("{}  {}  {}  {}  {state}  {}\n", key.id, key.tenant, scopes(key), key.created_at, key.name)
            };
            super::print(&keys.iter().map(line).collect::<String>())
        }
        KeysCommand::Revoke { id } if store.revoke_key(&id).await? => super::print(&format!("revoked {id}\n")),
        KeysCommand::Revoke { id } => {
            let message = format!("there is no valid key `{id}`; `intarsia keys list` lists all");
            Err(Failure::new(Code::InvalidRequest, message))
        }
    }
}

fn scopes(key: &Key) -> String {
    let names: Vec<&str> = key.scopes.iter().map(|s| s.as_str()).collect();
    names.join(",")
}
