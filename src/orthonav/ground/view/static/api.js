// Requests to the server, which only reads.

/** The JSON at a path; throws an Error with the message of the server. */
export async function getJson(path) {
  const reply = await fetch(path, { cache: "no-store" });
  if (!reply.ok) throw new Error((await reply.text()).trim() || reply.statusText);
  return reply.json();
}

export const viewUrl = (index) => `api/views/${index}/view.png`;
export const rawUrl = (index) => `api/views/${index}/raw.jpg`;
export const mapUrl = (index, at) => `api/views/${index}/map-${at}.png`;
