// Requests to the server, which only reads.

/** The JSON at a path; throws an Error with the message of the server. */
export async function getJson(path) {
  const reply = await fetch(path, { cache: "no-store" });
  if (!reply.ok) throw new Error((await reply.text()).trim() || reply.statusText);
  return reply.json();
}

/** What is new after so many views and lines of health. */
export function getNews(generation, views, health) {
  return getJson(`api/news?generation=${generation}&views=${views}&health=${health}`);
}

const POLL_MS = 500;
const POLL_LATER_MS = 3000;

/** Polls for news, twice a second while the page is visible; `take` is called with each response,
    `lost` with true when the server does not respond and with false when it does again. */
export function follow(state, take, lost) {
  let timer = 0;
  const once = async () => {
    clearTimeout(timer);
    let wait = document.hidden ? POLL_LATER_MS : POLL_MS;
    try {
      take(await getNews(...state()));
      lost(false);
    } catch {
      lost(true);
      wait = POLL_LATER_MS;
    }
    clearTimeout(timer);
    timer = setTimeout(once, wait);
  };
  timer = setTimeout(once, POLL_MS);
}

export const viewUrl = (index, generation) => `api/views/${index}/view.png?g=${generation}`;
export const rawUrl = (index, generation) => `api/views/${index}/raw.jpg?g=${generation}`;
export const mapUrl = (index, at, generation) => `api/views/${index}/map-${at}.png?g=${generation}`;
