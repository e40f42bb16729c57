// What is asked of the server: everything is read, nothing is sent.

/** The JSON at a path; throws an Error with what the server said. */
export async function getJson(path) {
  const reply = await fetch(path, { cache: "no-store" });
  if (!reply.ok) throw new Error((await reply.text()).trim() || reply.statusText);
  return reply.json();
}

/** What came after so many views and lines of health. */
export function getNews(generation, views, health) {
  return getJson(`api/news?generation=${generation}&views=${views}&health=${health}`);
}

const POLL_MS = 500;
const POLL_LATER_MS = 3000;

/** Asks for news for ever, twice a second while the page is seen; `told` is called with each
    answer, `lost` with true where the server does not answer and with false when it does again. */
export function follow(state, told, lost) {
  let timer = 0;
  const once = async () => {
    clearTimeout(timer);
    let wait = document.hidden ? POLL_LATER_MS : POLL_MS;
    try {
      told(await getNews(...state()));
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
