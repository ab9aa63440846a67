"""`dvax explore`: a local page on which parameters are moved and the solution is drawn again.

`subject.py` says what can be explored, `contact.py`, `model.py` and `saved.py` are the three kinds of
it, `server.py` serves the page, and `page.html`, `page.css` and `page.js` are the page.
"""
