// The service: problems as errors, uploads with progress, and events of a job that outlive a broken connection.

export class Problem extends Error {
  constructor(status, body) {
    super(body?.detail ?? body?.title ?? `The service answered ${status}.`);
    this.status = status;
    this.code = body?.code;
    this.errors = body?.errors ?? [];
  }
}

const pause = (ms, signal) => new Promise((yes) => { const timer = setTimeout(yes, ms); signal?.addEventListener("abort", () => { clearTimeout(timer); yes(); }, { once: true }); });

const KEY = "intarsia.key";

// The API key of this tab, where the service asks for one.
let apiKey = null;
try { apiKey = sessionStorage.getItem(KEY); } catch { /* It lasts as long as the page. */ }

export const hasKey = () => Boolean(apiKey);

export function useKey(key) {
  apiKey = key;
  try { sessionStorage.setItem(KEY, key); } catch { /* The same. */ }
}

const authorization = () => (apiKey ? { Authorization: `Bearer ${apiKey}` } : {});

export async function call(path, options) {
  const response = await fetch(path, { ...options, headers: { ...options?.headers, ...authorization() } });
  if (!response.ok) throw new Problem(response.status, await response.json().catch(() => null));
  return response;
}

export const json = (path, options) => call(path, options).then((r) => r.json());

/** Posts a form; `progress` is told the fraction that is sent. Gives the job. */
export function upload(form, progress, signal) {
  return new Promise((yes, no) => {
    const request = new XMLHttpRequest();
    request.open("POST", "v1/jobs");
    for (const [name, value] of Object.entries(authorization())) request.setRequestHeader(name, value);
    request.responseType = "json";
    request.upload.addEventListener("progress", (event) => event.lengthComputable && progress(event.loaded / event.total, event.total));
    request.addEventListener("load", () => (request.status < 300 ? yes(request.response) : no(new Problem(request.status, request.response))));
    request.addEventListener("error", () => no(new Error("The service cannot be reached. Is it running? Nothing was submitted; try again.")));
    request.addEventListener("abort", () => no(new DOMException("the upload was stopped", "AbortError")));
    signal.addEventListener("abort", () => request.abort(), { once: true });
    request.send(form);
  });
}

/** Follows a job until it is final. `handlers`: `event(name, data)`, `lost(error)`, `back()`. */
export async function follow(id, handlers, signal) {
  let last = null, failures = 0, final = false;
  while (!final && !signal.aborted) {
    try {
      const response = await call(`v1/jobs/${id}/events`, { signal, headers: last ? { "Last-Event-ID": last } : {} });
      if (failures) handlers.back();
      failures = 0;
      for await (const event of events(response.body)) {
        if (event.id) last = event.id;
        if (!event.data) continue;
        const data = JSON.parse(event.data);
        handlers.event(event.name, data);
        final ||= event.name === "state" && isFinal(data.state);
      }
      if (!final) throw new Error("the stream ended");
    } catch (error) {
      if (signal.aborted) return;
      if (error instanceof Problem && error.status < 500 && error.status !== 429) throw error;
      failures++;
      handlers.lost(error);
      await pause(Math.min(500 * 1.6 ** (failures - 1), 5000), signal);
    }
  }
}

export const isFinal = (state) => !["queued", "running"].includes(state);

/** Server-sent events of a body. */
async function* events(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    text = (text + value).replaceAll("\r\n", "\n");
    for (let end; (end = text.indexOf("\n\n")) >= 0; text = text.slice(end + 2)) {
      const event = { name: "message", id: null, data: "" };
      for (const line of text.slice(0, end).split("\n")) {
        const [, key, rest] = line.match(/^(\w+): ?(.*)$/) ?? [];
        if (key === "event") event.name = rest;
        else if (key === "id") event.id = rest;
        else if (key === "data") event.data += (event.data ? "\n" : "") + rest;
      }
      yield event;
    }
  }
}
