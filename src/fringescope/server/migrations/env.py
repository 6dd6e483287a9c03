"""How Alembic reaches the database: the engine is handed over by `database.migrate`."""

from alembic import context

from fringescope.server.database import metadata

with context.config.attributes["engine"].begin() as connection:
    context.configure(connection=connection, target_metadata=metadata, render_as_batch=True)
    with context.begin_transaction():
        context.run_migrations()
