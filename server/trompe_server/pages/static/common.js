// Shared by all pages: requests with the API's error messages, buttons that post, and one notice for errors.

const notice = document.getElementById("notice");

export function tell(text) {
  notice.textContent = text;
  notice.hidden = !text;
}

export class Refused extends Error {
  constructor(problem) {
    super(problem.detail || problem.title);
    this.problem = problem;
  }
}

// The JSON of an answer. Throws Refused with the server's message, or a TypeError without a connection.
export const ask = async (path, options = {}) => answered(await fetch(path, options));

export async function answered(answer) {
  if (answer.status === 401) location.assign(`/login?next=${encodeURIComponent(location.pathname + location.search)}`);
  if (!answer.ok) throw new Refused(await answer.json().catch(() => ({ title: `The server answered ${answer.status}` })));
  return answer.status === 204 ? null : answer.json();
}

export const words = (error) =>
  error instanceof Refused ? error.message : "The server cannot be reached; check that it runs, then try again.";

// Follow a stream, across lost connections; `onMessage` gets the data of each event. Returns a stop function.
export function follow(path, name, onMessage) {
  let source, timer, lost = false;
  const open = () => {
    source = new EventSource(path);
    source.addEventListener(name, (event) => onMessage(event.data));
    source.onopen = () => {
      if (lost) tell("");
      lost = false;
    };
    source.onerror = () => {
      lost = true;
      tell("The connection to the server is lost; reconnecting.");
      if (source.readyState !== EventSource.CLOSED) return;
      timer = setTimeout(open, 2000);
      fetch(location.href).then(answered).catch(() => {}); // the token may be revoked
    };
  };
  const stop = () => {
    clearTimeout(timer);
    source?.close();
  };
  // A browser has six connections to a server for all its tabs, so only those that are seen hold one.
  const heed = () => (document.hidden ? stop() : open());
  document.addEventListener("visibilitychange", heed);
  addEventListener("pagehide", stop);
  heed();
  return stop;
}

// Buttons with data-delete: the row of a list goes with its job.
document.addEventListener("click", async (event) => {
  const button = event.target.closest("button[data-delete]");
  if (!button || !confirm("Delete the job and all its files?")) return;
  try {
    await ask(button.dataset.delete, { method: "DELETE" });
    button.closest("tr").remove();
  } catch (error) {
    tell(words(error));
  }
});

// Buttons with data-post.
document.addEventListener("click", async (event) => {
  const button = event.target.closest("button[data-post]");
  if (!button) return;
  button.disabled = true;
  try {
    const job = await ask(button.dataset.post, { method: "POST" });
    if (location.pathname !== `/jobs/${job.id}` && button.dataset.post.endsWith("/retry")) location.assign(`/jobs/${job.id}`);
    else if (!document.querySelector("table[data-stream]")) location.reload();
  } catch (error) {
    tell(words(error));
    button.disabled = false;
  }
});
