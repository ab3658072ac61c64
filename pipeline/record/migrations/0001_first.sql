-- One row: the job that this folder belongs to.
CREATE TABLE job (
    id             INTEGER PRIMARY KEY CHECK (id = 1),
    name           TEXT    NOT NULL,
    created        REAL    NOT NULL,               -- wall time [s since the epoch], as all times here
    clean_shutdown INTEGER NOT NULL
);

-- Parameter sets by digest, so that an old one can be compared with a new one.
CREATE TABLE parameters (
    digest    TEXT PRIMARY KEY,
    stage     TEXT NOT NULL,
    canonical TEXT NOT NULL
) WITHOUT ROWID;

-- Every task there ever was. `position` is its place in the present plan, NULL if the plan has it no more.
CREATE TABLE task (
    id         TEXT PRIMARY KEY,
    position   INTEGER,
    stage      TEXT NOT NULL,
    subject    TEXT NOT NULL,
    frame      INTEGER,
    parameters TEXT REFERENCES parameters (digest),
    state      TEXT NOT NULL
) WITHOUT ROWID;
CREATE INDEX task_by_state ON task (stage, state, position) WHERE position IS NOT NULL;

-- Append-only: every try of every task. A number is never used twice, for late writers are told apart by it.
CREATE TABLE attempt (
    task              TEXT    NOT NULL REFERENCES task (id),
    number            INTEGER NOT NULL,
    started           REAL    NOT NULL,
    finished          REAL,
    outcome           TEXT,                        -- NULL while it runs, 'succeeded', or the kind of failure
    message           TEXT    NOT NULL DEFAULT '',
    seconds           REAL,
    peak_memory_bytes INTEGER,
    host              TEXT    NOT NULL DEFAULT '',
    log               TEXT    NOT NULL DEFAULT '',
    PRIMARY KEY (task, number)
) WITHOUT ROWID;
CREATE INDEX attempt_running ON attempt (task) WHERE finished IS NULL;

-- What stands on disk, as the receipts tell it.
CREATE TABLE artifact (
    path        TEXT    PRIMARY KEY,
    task        TEXT    NOT NULL REFERENCES task (id),
    attempt     INTEGER NOT NULL,
    fingerprint TEXT    NOT NULL,
    parameters  TEXT    NOT NULL,                  -- digest; its text may be unknown after a rebuild
    size        INTEGER NOT NULL,
    mtime_ns    INTEGER NOT NULL,
    hash        TEXT    NOT NULL,
    inputs      TEXT    NOT NULL                   -- JSON object, path -> hash
) WITHOUT ROWID;

CREATE TABLE event (
    id      INTEGER PRIMARY KEY,
    time    REAL NOT NULL,
    kind    TEXT NOT NULL,
    task    TEXT,
    message TEXT NOT NULL
);
CREATE INDEX event_by_task ON event (task, id);
