// Search results: keys and columns first, the pages for users next, design notes last.
var Scorer = {
  score: ([page, title, anchor, description, score]) =>
    page.startsWith("design/") ? score / 4 : anchor.startsWith("#key-") ? score + 100 : score,
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
