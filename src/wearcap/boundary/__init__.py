"""The one room for bytes from outside: files, messages and pages that somebody else wrote.

`limits` has what each kind of content may take (`LIMITS`) and counts it (`Budget`); `opening` opens regular files alone,
unpacks them within their budget, and keeps paths inside their folder; `texts` (lines, JSON by a schema, YAML, XML), `arrays`
(.npz, .npy), `tensors` (.safetensors) and `pickles` (plain data of public data sets) take content apart; `own` says which
files of formats that can run code are the user's own. All raise WearcapError and nothing else.
"""
