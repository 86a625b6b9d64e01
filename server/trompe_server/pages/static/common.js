// What all pages share: requests with the API's own error messages, buttons that post, one notice for what goes wrong.

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

// The JSON of an answer. Throws Refused with the server's own words, or a TypeError where there is no connection.
export async function ask(path, options = {}) {
  const answer = await fetch(path, options);
  if (answer.status === 401) location.assign(`/login?next=${encodeURIComponent(location.pathname)}`);
  if (!answer.ok) throw new Refused(await answer.json().catch(() => ({ title: `The server answered ${answer.status}` })));
  return answer.status === 204 ? null : answer.json();
}

export const words = (error) =>
  error instanceof Refused ? error.message : "The server cannot be reached; check that it runs, then try again.";

// Events of a stream, again and again after a lost connection; `onMessage` gets each one's data. Returns a stop function.
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
      tell("The connection to the server is lost; trying again.");
      if (source.readyState === EventSource.CLOSED) timer = setTimeout(open, 2000);
    };
  };
  open();
  const stop = () => {
    clearTimeout(timer);
    source.close();
  };
  addEventListener("pagehide", stop);
  return stop;
}

// Buttons with data-post: what they start is shown by the page that they lead to.
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
