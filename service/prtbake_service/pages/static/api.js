// Calls to the REST interface, with the API key in the header.

export class ApiError extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

export class Api {
  #key;

  constructor(key) { this.#key = key; }

  async #fetch(path, options = {}) {
    const headers = { ...options.headers, Authorization: `Bearer ${this.#key}` };
    const response = await fetch(path, { ...options, headers, credentials: "omit" });
    if (response.ok) return response;
    const problem = await response.json().catch(() => ({}));
    throw new ApiError(response.status, problem.detail ?? `The service answered ${response.status}.`);
  }

  async jobs({ state, cursor }) {
    const query = new URLSearchParams();
    if (state) query.set("state", state);
    if (cursor) query.set("cursor", cursor);
    return (await this.#fetch(`/v1/jobs?${query}`)).json();
  }

  async cancel(id) { await this.#fetch(`/v1/jobs/${encodeURIComponent(id)}/cancel`, { method: "POST" }); }

  async retry(id) { await this.#fetch(`/v1/jobs/${encodeURIComponent(id)}/retry`, { method: "POST" }); }

  async artefact(id, name) {
    const path = `/v1/jobs/${encodeURIComponent(id)}/artefacts/${encodeURIComponent(name)}`;
    return (await this.#fetch(path)).blob();
  }
}
