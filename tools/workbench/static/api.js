// Requests to the server of the workbench. Every answer is JSON; an error is {error: "one line"}.

export class ApiError extends Error {
  constructor(words, status) {
    super(words);
    this.status = status;
  }
}

async function send(path, options) {
  let answer;
  try {
    answer = await fetch(`/api${path}`, { credentials: "same-origin", cache: "no-store", ...options });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new ApiError("The server does not answer. Is `socast serve` still running?", 0);
  }
  const record = await answer.json().catch((error) => {
    if (error.name === "AbortError") throw error; // the page was left while the answer was read
    return null;
  });
  if (!answer.ok) throw new ApiError(record?.error ?? `The server answered ${answer.status}.`, answer.status);
  return record;
}

// Return the record of GET /api{path}. `signal` ends the request when a page is left.
export function get(path, { signal } = {}) {
  return send(path, { signal });
}

// Return the record of POST /api{path}.
export function post(path, body = {}) {
  return send(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
}

// Start background work by POST /api{path}, follow it, and return its result. `onProgress` receives
// {share, words, cancel}; `cancel()` asks the server to stop the work. The work waits for other work that runs.
export async function job(path, body, onProgress = () => {}) {
  for (;;) {
    try {
      return await follow(await post(path, body), onProgress);
    } catch (error) {
      const busy = /^another job runs: ([^;]*);/.exec(error.message);
      if (!busy) throw error;
      onProgress({ words: `waiting for ${busy[1]}` });
      await new Promise((resolve) => setTimeout(resolve, 500));
    }
  }
}

// Follow background work from its record, and return its result.
export async function follow(record, onProgress = () => {}) {
  const cancel = () => post(`/jobs/${record.job}/cancel`);
  while (record.status === "running") {
    onProgress({ share: record.share, words: record.words, cancel });
    await new Promise((resolve) => setTimeout(resolve, 250));
    record = await get(`/jobs/${record.job}`);
  }
  if (record.status === "done") return record.result;
  throw new ApiError(record.status === "cancelled" ? "Cancelled." : record.error, 422);
}

// Return a path with its parameters; those that are undefined, null or empty are left out.
export function withParameters(path, parameters) {
  const given = Object.entries(parameters).filter(([, value]) => value !== undefined && value !== null && value !== "");
  const text = new URLSearchParams(given).toString();
  return text ? `${path}?${text}` : path;
}
