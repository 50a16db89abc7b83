//! Which store a service has.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey, S3ConditionalPut, S3CopyIfNotExists};
use object_store::path::Path as Key;
use object_store::{BackoffConfig, ClientOptions, ObjectStore, RetryConfig};

use super::Store;
use super::folder::Folder;
use super::objects::Objects;
use crate::error::{Code, Failure, Result};
use crate::jobs::files::Files;

/// How long one request may take, and how long it is sent again where it fails.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(30);
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
const RETRY_TIMEOUT: Duration = Duration::from_secs(20);
const RETRIES: usize = 6;

/// Opens the store at `address`: a folder, `s3://bucket/prefix`, or none, which is the data folder itself. So much must be free on the volume of
/// a folder.
///
/// # Errors
/// `invalid_request`: no such address; `unavailable`: the store cannot be used, or must not be shared.
pub async fn open(address: Option<&str>, files: &Files, min_free: Option<u64>) -> Result<Arc<dyn Store>> {
    let Some(address) = address else { return Ok(Arc::new(Folder::of_data(files)?)) };
    let Some((scheme, rest)) = address.split_once("://") else {
        return match same(Path::new(address), files.root()) {
            true => Ok(Arc::new(Folder::of_data(files)?)),
            false => Ok(Arc::new(Folder::at(Path::new(address), min_free)?)),
        };
    };
    let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
    if bucket.is_empty() || bucket.contains('@') || prefix.contains(['?', '#']) {
        return Err(invalid("--store names a bucket and a prefix, and nothing else: s3://BUCKET/PREFIX"));
    }
    let prefix = Key::parse(prefix).map_err(|e| invalid(&format!("--store has a prefix that cannot be: {e}")))?;
    // One of its parts may speak TLS, and none brings its own.
    let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
    let store: Arc<dyn ObjectStore> = match scheme {
        "s3" => s3(bucket)?,
        #[cfg(feature = "gcs")]
        "gs" => {
            let builder = object_store::gcp::GoogleCloudStorageBuilder::from_env().with_bucket_name(bucket);
            let built = builder.with_client_options(client()).with_retry(retry()).build();
            Arc::new(built.map_err(|e| configuration(&e))?)
        }
        #[cfg(feature = "azure")]
        "az" => {
            let builder = object_store::azure::MicrosoftAzureBuilder::from_env().with_container_name(bucket);
            let built = builder.with_client_options(client()).with_retry(retry()).build();
            Arc::new(built.map_err(|e| configuration(&e))?)
        }
        "gs" | "az" => {
            let feature = if scheme == "gs" { "gcs" } else { "azure" };
            return Err(invalid(&format!(
                "this program was built without {scheme}://: build it with `--features {feature}`"
            )));
        }
        _ => {
            return Err(invalid(
                "--store is a folder, or s3://BUCKET/PREFIX (gs:// and az:// where they were built in)",
            ));
        }
    };
    let objects = Objects::new(store, prefix, format!("{scheme}://{rest}"));
    objects.probe().await?;
    Ok(Arc::new(objects))
}

fn s3(bucket: &str) -> Result<Arc<dyn ObjectStore>> {
    let mut builder = AmazonS3Builder::from_env().with_bucket_name(bucket);
    // Who names an endpoint without TLS means it.
    let plain =
        builder.get_config_value(&AmazonS3ConfigKey::Endpoint).is_some_and(|endpoint| endpoint.starts_with("http://"));
    builder = builder
        .with_client_options(client().with_allow_http(plain))
        .with_retry(retry())
        .with_conditional_put(S3ConditionalPut::ETagMatch)
        .with_copy_if_not_exists(S3CopyIfNotExists::Multipart);
    Ok(Arc::new(builder.build().map_err(|e| configuration(&e))?))
}

fn client() -> ClientOptions {
    ClientOptions::new().with_timeout(REQUEST_TIMEOUT).with_connect_timeout(CONNECT_TIMEOUT)
}

fn retry() -> RetryConfig {
    RetryConfig { backoff: BackoffConfig::default(), max_retries: RETRIES, retry_timeout: RETRY_TIMEOUT }
}

fn configuration(error: &object_store::Error) -> Failure {
    // Names of settings, and none of their values, are worth telling.
    tracing::debug!(%error, "the store cannot be configured");
    invalid(
        "the settings of --store in the environment (AWS_ENDPOINT, AWS_REGION, AWS_ACCESS_KEY_ID, …) do not fit together",
    )
}

fn invalid(why: &str) -> Failure {
    Failure::new(Code::InvalidRequest, why)
}

/// Whether two paths are one folder.
fn same(one: &Path, other: &Path) -> bool {
    match (one.canonicalize(), other.canonicalize()) {
        (Ok(one), Ok(other)) => one == other,
        _ => one == other,
    }
}
