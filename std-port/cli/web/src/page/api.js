// The way to the server: what changes, and what is asked for. The token goes into a header and nowhere else.

const KEPT = "cara-token";

export function token() {
  const told = decodeURIComponent(location.hash.slice(1));
  if (told) {
    sessionStorage.setItem(KEPT, told);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem(KEPT) ?? "";
}

export const keepToken = (value) => sessionStorage.setItem(KEPT, value.trim());

const headers = () => ({ authorization: `Bearer ${token()}` });

// Calls `each` with each message until the connection ends; throws why it did.
export async function follow(each, onOpen, signal) {
  const response = await fetch("api/stream", { headers: headers(), cache: "no-store", signal });
  if (!response.ok) throw Object.assign(new Error(await response.text()), { status: response.status });
  onOpen();
  for await (const message of pieces(response.body, "\n\n")) {
    if (message.startsWith("data: ")) each(JSON.parse(message.slice(6)));
  }
  throw new Error("the server has closed the connection");
}

// Asks, and yields each line of the answer.
export async function* ask(path, body, signal, priority = "auto") {
  const response = await fetch(path, {
    method: "POST", signal, priority, cache: "no-store",
    headers: { ...headers(), "content-type": "application/json", "x-cara": "1" },
    body: JSON.stringify(body),
  });
  if (!response.ok) throw Object.assign(new Error(`${response.status}: ${await response.text()}`), { status: response.status });
  for await (const line of pieces(response.body, "\n")) yield JSON.parse(line);
}

export async function beat(hold) {
  for await (const _ of ask("api/beat", { hold })) { /* it has no answer */ }
}

export async function map() {
  const response = await fetch("api/map", { headers: headers() });
  return response.ok ? response.json() : null;
}

async function* pieces(body, end) {
  if (!body) return;
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      rest += value;
      const all = rest.split(end);
      rest = all.pop();
      yield* all.filter((piece) => piece);
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}
