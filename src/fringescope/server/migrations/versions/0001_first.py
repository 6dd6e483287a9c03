"""The first tables, and triggers that let nobody change or remove an event."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

Text, Big, Flag = sa.Text, sa.BigInteger, sa.Boolean


def upgrade() -> None:
    """Makes them."""
    op.create_table(
        "people",
        sa.Column("id", Text, primary_key=True),
        sa.Column("name", Text, nullable=False, unique=True),
        sa.Column("role", Text, nullable=False),
        sa.Column("password", Text, nullable=False),
        sa.Column("disabled", Flag, nullable=False),
        sa.Column("failures", sa.Integer, nullable=False),
        sa.Column("locked_ns", Big, nullable=False),
        sa.Column("created_ns", Big, nullable=False),
        sa.Column("case_id", Text),
        sa.Column("expires_ns", Big),
        sa.Column("subject", Text, unique=True),
    )
    op.create_table(
        "passkeys",
        sa.Column("id", Text, primary_key=True),
        sa.Column("person_id", Text, sa.ForeignKey("people.id"), nullable=False, index=True),
        sa.Column("public_key", sa.LargeBinary, nullable=False),
        sa.Column("sign_count", Big, nullable=False),
        sa.Column("label", Text, nullable=False),
        sa.Column("created_ns", Big, nullable=False),
    )
    op.create_table(
        "sessions",
        sa.Column("digest", Text, primary_key=True),
        sa.Column("person_id", Text, sa.ForeignKey("people.id"), nullable=False, index=True),
        sa.Column("csrf", Text, nullable=False),
        sa.Column("created_ns", Big, nullable=False),
        sa.Column("seen_ns", Big, nullable=False),
        sa.Column("confirmed_ns", Big, nullable=False),
    )
    op.create_table(
        "cases",
        sa.Column("id", Text, primary_key=True),
        sa.Column("accession", Text, nullable=False, index=True),
        sa.Column("status", Text, nullable=False, index=True),
        sa.Column("specimen", sa.JSON, nullable=False),
        sa.Column("created_ns", Big, nullable=False),
        sa.Column("changed_ns", Big, nullable=False),
    )
    op.create_table(
        "patients",
        sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
        sa.Column("name", Text, nullable=False),
        sa.Column("identifier", Text, nullable=False, index=True),
        sa.Column("born", Text, nullable=False),
    )
    op.create_table(
        "members",
        sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
        sa.Column("person_id", Text, sa.ForeignKey("people.id"), primary_key=True),
    )
    op.create_table(
        "invitations",
        sa.Column("id", Text, primary_key=True),
        sa.Column("case_id", Text, sa.ForeignKey("cases.id"), nullable=False, index=True),
        sa.Column("digest", Text, nullable=False, unique=True),
        sa.Column("code", Text, nullable=False),
        sa.Column("failures", sa.Integer, nullable=False),
        sa.Column("role", Text, nullable=False),
        sa.Column("name", Text, nullable=False),
        sa.Column("expires_ns", Big, nullable=False),
        sa.Column("revoked", Flag, nullable=False),
        sa.Column("used_ns", Big),
        sa.Column("person_id", Text, sa.ForeignKey("people.id")),
        sa.Column("made_by", Text, nullable=False),
    )
    op.create_table(
        "events",
        sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
        sa.Column("seq", Big, primary_key=True, autoincrement=False),
        sa.Column("at_ns", Big, nullable=False),
        sa.Column("said_ns", Big, nullable=False),
        sa.Column("actor", Text, nullable=False),
        sa.Column("role", Text, nullable=False),
        sa.Column("client", Text, nullable=False),
        sa.Column("number", Big, nullable=False),
        sa.Column("kind", Text, nullable=False),
        sa.Column("refused", Text, nullable=False),
        sa.Column("digest", Text, nullable=False),
        sa.Column("prev", Text, nullable=False),
        sa.Column("hash", Text, nullable=False),
        sa.UniqueConstraint("case_id", "actor", "client", "number", name="said_once"),
    )
    op.create_table(
        "payloads",
        sa.Column("case_id", Text, primary_key=True),
        sa.Column("seq", Big, primary_key=True, autoincrement=False),
        sa.Column("salt", Text, nullable=False),
        sa.Column("body", sa.JSON, nullable=False),
        sa.ForeignKeyConstraint(["case_id", "seq"], ["events.case_id", "events.seq"]),
    )
    op.create_table(
        "scans",
        sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
        sa.Column("id", Text, primary_key=True),
        sa.Column("rig", Text, nullable=False),
        sa.Column("label", Text, nullable=False),
        sa.Column("taken_ns", Big, nullable=False),
        sa.Column("figures", sa.JSON, nullable=False),
    )
    op.create_table(
        "blobs",
        sa.Column("case_id", Text, sa.ForeignKey("cases.id"), primary_key=True),
        sa.Column("owner", Text, primary_key=True),
        sa.Column("name", Text, primary_key=True),
        sa.Column("sha256", Text, nullable=False, index=True),
        sa.Column("size", Big, nullable=False),
        sa.Column("type", Text, nullable=False),
    )
    op.create_table(
        "jobs",
        sa.Column("id", Text, primary_key=True),
        sa.Column("kind", Text, nullable=False),
        sa.Column("case_id", Text),
        sa.Column("person_id", Text, nullable=False),
        sa.Column("state", Text, nullable=False),
        sa.Column("stage", Text, nullable=False),
        sa.Column("share", sa.Float, nullable=False),
        sa.Column("why", Text, nullable=False),
        sa.Column("result", sa.JSON),
        sa.Column("created_ns", Big, nullable=False),
        sa.Column("ended_ns", Big),
    )
    _keep_events()


def _keep_events() -> None:
    """Events are only ever added; words are never changed, and removed by an erasure alone."""
    if op.get_bind().dialect.name == "sqlite":
        for table, what in (("events", "UPDATE"), ("events", "DELETE"), ("payloads", "UPDATE")):
            op.execute(
                f"CREATE TRIGGER {table}_no_{what.lower()} BEFORE {what} ON {table} "
                f"BEGIN SELECT RAISE(ABORT, 'the log is only ever added to'); END"
            )
    else:
        op.execute(
            "CREATE FUNCTION only_added() RETURNS trigger LANGUAGE plpgsql AS "
            "$$ BEGIN RAISE EXCEPTION 'the log is only ever added to'; END $$"
        )
        op.execute(
            "CREATE TRIGGER events_kept BEFORE UPDATE OR DELETE OR TRUNCATE ON events "
            "FOR EACH STATEMENT EXECUTE FUNCTION only_added()"
        )
        op.execute(
            "CREATE TRIGGER payloads_kept BEFORE UPDATE OR TRUNCATE ON payloads "
            "FOR EACH STATEMENT EXECUTE FUNCTION only_added()"
        )


def downgrade() -> None:
    """Removes them all."""
    if op.get_bind().dialect.name != "sqlite":
        op.execute("DROP TRIGGER IF EXISTS events_kept ON events")
        op.execute("DROP TRIGGER IF EXISTS payloads_kept ON payloads")
        op.execute("DROP FUNCTION IF EXISTS only_added()")
    for table in ("jobs", "blobs", "scans", "payloads", "events", "invitations", "members", "patients", "cases",
                  "sessions", "passkeys", "people"):  # fmt: skip
        op.drop_table(table)
